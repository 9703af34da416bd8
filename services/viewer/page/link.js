// The socket to this machine's `flockeye view`: opens it again where it closes, and says why it cannot.

const PROTOCOL = 1;
const decoder = new TextDecoder();

export class Link {
  constructor({ onText, onBinary, onTrouble }) {
    Object.assign(this, { onText, onBinary, onTrouble });
    this.token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
    this.wait = 500;
    this.wanted = true;
    document.addEventListener("visibilitychange", () => this.askForPictures());
    this.open();
  }

  open() {
    const query = this.token ? `?token=${encodeURIComponent(this.token)}` : "";
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/live${query}`);
    this.socket.binaryType = "arraybuffer";
    let wasOpen = false;
    this.socket.onopen = () => {
      wasOpen = true;
      this.wait = 500;
      this.onTrouble("");
      this.askForPictures();
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return this.binary(data);
      const message = JSON.parse(data);
      if (message.kind === "hello" && message.protocol !== PROTOCOL) {
        return this.onTrouble("this page is of another version: load it again");
      }
      this.onText(message);
    };
    this.socket.onclose = async () => {
      const why = wasOpen ? "" : await this.reason(query);
      this.onTrouble(why || "the view has ended; waiting for it");
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(this.wait * 1.6, 5000);
    };
  }

  // A browser does not tell a page why its socket was refused, so it asks.
  async reason(query) {
    try {
      const answer = await fetch(`/access${query}`);
      return answer.ok ? "too many pages are open" : (await answer.text()).trim();
    } catch {
      return "";
    }
  }

  binary(data) {
    const length = new DataView(data).getUint32(0, true);
    const head = JSON.parse(decoder.decode(new Uint8Array(data, 4, length)));
    this.onBinary(head, new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
  }

  wantPictures(wanted) {
    if (this.wanted === wanted) return;
    this.wanted = wanted;
    this.askForPictures();
  }

  // Nobody looks at a hidden page.
  askForPictures() {
    this.send({ pictures: this.wanted && !document.hidden });
  }

  shown() {
    this.send({ shown: 1 });
  }

  send(command) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(command));
  }
}
