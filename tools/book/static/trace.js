// A trace without a kernel: some pixels, Gaussians and voxels, and what happened to each of them, in order.
class RecordedTrace {
  constructor({ label, stories, follows, files }, el) {
    Object.assign(this, { stories, follows, files });
    el.innerHTML = `<div class="gsnb-recorded gsnb-recorded-trace" role="group">
      <img class="gsnb-recorded-image" alt="" data-touch="pixel">
      <div class="gsnb-recorded-side">
        <label><span>follow</span><select name="story"></select></label>
        <label><span>a click follows</span><select name="kind"></select></label>
        <label><span>moment</span><input type="range" name="moment" min="0" step="1"><output></output></label>
        <p><button type="button" name="back">Previous</button> <button type="button" name="next">Next</button></p>
        <div class="gsnb-recorded-words" aria-live="polite" tabindex="0" role="group" aria-label="what happened"></div>
      </div></div>`;
    const find = (what) => el.querySelector(what);
    [this.image, this.words, this.output] = [find("img"), find(".gsnb-recorded-words"), find("output")];
    [this.story, this.kind, this.slider] = [find("[name=story]"), find("[name=kind]"), find("[name=moment]")];
    [this.back, this.next] = [find("[name=back]"), find("[name=next]")];
    find(".gsnb-recorded").setAttribute("aria-label", label);
    this.story.append(...stories.map(({ name }, k) => new Option(name, k)));
    this.kind.append(...Object.keys(follows).map((kind) => new Option(kind, kind)));
    this.story.addEventListener("input", () => this.follow(Number(this.story.value)));
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value)));
    this.back.addEventListener("click", () => this.show(this.at - 1));
    this.next.addEventListener("click", () => this.show(this.at + 1));
    this.image.addEventListener("click", (event) => this.clicked(event));
    this.follow(0, stories[0].start);
  }

  /** Begin another story, at the moment that is nearest in time to the present one, as in the notebook. */
  follow(number, moment) {
    const now = this.now && this.now[0];
    this.number = number;
    this.story.value = number;
    const { moments } = this.stories[number];
    this.slider.max = moments.length - 1;
    const away = moments.map(([serial]) => Math.abs(serial - now));
    this.show(moment ?? away.indexOf(Math.min(...away)));
  }

  show(k) {
    const { name, moments, count } = this.stories[this.number];
    this.at = Math.min(Math.max(k, 0), moments.length - 1);
    this.now = moments[this.at];
    const [, picture, alt, words, number] = this.now;
    this.image.src = `${this.files}${picture}`;
    this.image.alt = alt;
    this.words.innerHTML = words;
    this.slider.value = this.at;
    this.output.value = `${number} / ${count}`;
    this.slider.setAttribute("aria-valuetext", `${name}, moment ${number} of ${count}`);
    this.back.disabled = this.at === 0;
    this.next.disabled = this.at === moments.length - 1;
  }

  /** The recorded pixel that is next to a click. */
  clicked(event) {
    const box = this.image.getBoundingClientRect(), [columns, rows] = this.now[5];
    const u = ((event.clientX - box.left) / box.width) * columns, v = ((event.clientY - box.top) / box.height) * rows;
    const known = this.follows[this.kind.value];
    const away = known.map(([x, y]) => Math.hypot(x + 0.5 - u, y + 0.5 - v));
    this.follow(known[away.indexOf(Math.min(...away))][2]);
  }
}

export default {
  render({ model, el }) {
    new RecordedTrace(model, el);
  },
};
