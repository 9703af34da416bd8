// A recording: where it is, and what the view is asked for. One question is under way at a time; of several seeks
// only the last is asked, so that dragging goes as fast as the view can follow.

const clock = (seconds) => {
  const whole = Math.max(0, seconds);
  const minutes = Math.floor(whole / 60);
  return `${minutes}:${(whole - 60 * minutes).toFixed(2).padStart(5, "0")}`;
};

export class Playback {
  // `draw`: shows what has come, at once.
  constructor(link, root, draw) {
    Object.assign(this, { link, root, draw });
    const $ = (name) => root.querySelector(`#${name}`);
    [this.bar, this.button, this.time, this.rate] = [$("seek"), $("play"), $("clock"), $("speed")];
    this.bar.addEventListener("input", () => this.seek(Number(this.bar.value)));
    this.button.addEventListener("click", () => this.toggle());
    this.rate.addEventListener("change", () => {
      if (this.speed > 0) this.play();
      this.rate.blur();
    });
    this.end();
  }

  // `recording` of the message hello.
  begin(recording) {
    this.end();
    this.recording = recording;
    this.bar.max = recording.duration_s;
    this.root.hidden = false;
    document.body.classList.add("recorded");
    // The first position comes without a question.
    this.isWaiting = true;
    this.show();
  }

  end() {
    Object.assign(this, { recording: null, at: 0, speed: 0, picture: null, isWaiting: false, asked: 0, next: [] });
    this.root.hidden = true;
    document.body.classList.remove("recorded");
  }

  seek(to) {
    this.ask({ seek: Math.max(0, Math.min(this.recording.duration_s, to)) });
  }

  step(frames) {
    this.ask({ step: frames });
  }

  play(speed = Number(this.rate.value)) {
    this.ask({ play: speed });
  }

  toggle() {
    this.play(this.speed > 0 ? 0 : Number(this.rate.value));
  }

  ask(command) {
    const last = this.next.at(-1);
    if (last?.seek !== undefined && command.seek !== undefined) this.next.pop();
    if (last?.step !== undefined && command.step !== undefined) {
      this.next.pop();
      command = { step: last.step + command.step };
    }
    this.next.push(command);
    this.askNext();
  }

  askNext() {
    if (this.isWaiting || !this.next.length) return;
    this.isWaiting = true;
    this.asked += 1;
    this.link.send(this.next.shift());
  }

  // Takes a message `position`.
  take({ at_s: at, speed, picture, answers }) {
    Object.assign(this, { at, speed, picture });
    if (answers >= this.asked && this.isWaiting) {
      this.isWaiting = false;
      this.draw();
    }
    this.show();
    this.askNext();
  }

  show() {
    // While it is dragged, it shows where it is dragged to.
    if (!this.isWaiting) this.bar.value = this.at;
    const text = `${clock(this.at)} of ${clock(this.recording.duration_s)}`;
    if (this.time.textContent !== text) this.time.textContent = text;
    this.button.textContent = this.speed > 0 ? "pause" : "play";
  }
}
