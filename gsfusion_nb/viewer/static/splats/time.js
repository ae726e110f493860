// The slider over birth frames, and its play button.

const PLAY_MS = 6000; // from the first frame to the last

export class TimeLine {
  /** `changed` is called when another moment is shown; `until` is the last frame shown, null for all. */
  constructor(model, { timeline, time, when, play }, changed) {
    Object.assign(this, { model, timeline, time, when, button: play, changed });
    this.listeners = [["change:birth_range", () => this.show()], ["change:born_until", () => this.show()]];
    time.addEventListener("input", () => this.set(Number(time.value)));
    play.addEventListener("click", () => (this.timer ? this.rest() : this.play()));
    this.show();
  }

  get until() {
    return this.timer ? this.played : this.model.get("born_until");
  }

  show() {
    const [first, last] = this.model.get("birth_range");
    this.timeline.hidden = first === undefined || first === last;
    const until = this.until ?? last;
    Object.assign(this.time, { min: first, max: last, value: until });
    this.when.textContent = `map up to frame ${Math.round(until)}`;
    this.changed();
  }

  set(frame) {
    this.model.set("born_until", frame >= this.model.get("birth_range")[1] ? null : frame);
    this.model.save_changes();
    this.show();
  }

  /** Python is informed only at the end. */
  play() {
    const [first, last] = this.model.get("birth_range");
    const began = performance.now();
    this.button.textContent = "❚❚";
    this.played = first;
    this.timer = setInterval(() => {
      this.played = first + ((last - first) * (performance.now() - began)) / PLAY_MS;
      if (this.played < last) this.show();
      else this.rest();
    }, 60);
  }

  rest() {
    clearInterval(this.timer);
    this.timer = null;
    this.button.textContent = "▶";
    this.set(Math.floor(this.played));
  }
}
