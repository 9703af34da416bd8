// Why this pose, or why none: a panel with the answer of `flockeye explain`.

const decoder = new TextDecoder();

export class Explanation {
  constructor(root, link) {
    Object.assign(this, { root, link });
    const $ = (name) => root.querySelector(name);
    [this.title, this.picture, this.text] = [$("h2"), $("img"), $("pre")];
    $("button").addEventListener("click", () => this.close());
    // What is asked last counts.
    this.asked = 0;
  }

  async ask(name, key) {
    const mine = ++this.asked;
    this.title.textContent = `${name} in frame ${key.split(".").at(-1)}`;
    this.show("The flight is replayed up to this frame …");
    this.root.classList.add("waiting");
    this.root.hidden = false;
    let answer;
    try {
      answer = await this.answer(name, key);
    } catch {
      answer = { text: "the view has ended" };
    }
    if (mine !== this.asked) return;
    this.root.classList.remove("waiting");
    this.show(answer.text, answer.picture);
  }

  async answer(name, key) {
    const asked = new URLSearchParams({ target: name, frame: key });
    if (this.link.token) asked.set("token", this.link.token);
    const response = await fetch(`/explain?${asked}`);
    if (!response.ok) return { text: (await response.text()).trim() };
    const bytes = await response.arrayBuffer();
    const length = new DataView(bytes).getUint32(0, true);
    const picture = bytes.slice(4 + length);
    return {
      text: decoder.decode(new Uint8Array(bytes, 4, length)),
      picture: picture.byteLength ? new Blob([picture], { type: "image/png" }) : null,
    };
  }

  show(text, picture = null) {
    this.text.textContent = text;
    URL.revokeObjectURL(this.picture.src);
    this.picture.hidden = !picture;
    if (picture) this.picture.src = URL.createObjectURL(picture);
    else this.picture.removeAttribute("src");
  }

  close() {
    this.asked += 1;
    this.root.hidden = true;
    this.show("");
  }
}
