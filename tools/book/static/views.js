// Live views without a kernel. A view's data comes from a script beside the page, when the view is near the window; large
// data when its button is pressed. Steppers and viewers are the notebook's own scripts, with a model that answers for Python.
(() => {
  const LARGE = 1200000; // bytes that are not loaded without being asked for
  const root = document.currentScript.src.replace(/views\.js.*$/, "");
  const waiting = new Map();

  /** Called by each file of data. */
  window.gsnbView = (name, data) => waiting.get(name)?.(data);

  const loaded = new Map();
  function load(url) {
    if (!loaded.has(url)) {
      loaded.set(url, new Promise((resolve, reject) => {
        const script = document.createElement("script");
        Object.assign(script, { src: url, onload: resolve, onerror: () => reject(new Error(`${url} could not be loaded`)) });
        document.head.append(script);
      }));
    }
    return loaded.get(url);
  }

  const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));

  /** What a widget's script asks of its model. `answers`: trait -> what else changes with it. */
  class Model {
    constructor(values, { answers = {}, heard = () => {} } = {}) {
      Object.assign(this, { values: { ...values }, answers, heard, listeners: new Map() });
    }
    get(name) {
      return this.values[name];
    }
    set(names, value) {
      for (const [name, given] of typeof names === "string" ? [[names, value]] : Object.entries(names)) {
        if (this.values[name] === given) continue;
        this.values[name] = given;
        this.trigger(`change:${name}`);
        if (this.answers[name]) this.set(this.answers[name](given));
      }
    }
    on(event, act) {
      this.listeners.set(event, [...(this.listeners.get(event) ?? []), act]);
    }
    off(event, act) {
      this.listeners.set(event, (this.listeners.get(event) ?? []).filter((other) => other !== act));
    }
    trigger(event, ...details) {
      for (const act of this.listeners.get(event) ?? []) act(...details);
    }
    save_changes() {}
    send(message) {
      setTimeout(() => this.heard(message, this));
    }
  }

  function stepper(data) {
    const shown = (k) => {
      const [picture, alt, title, code, numbers] = data.steps[k];
      return { png: bytesOf(picture), alt, title, code, numbers, shown: k + 1 };
    };
    const { name, label, width } = data;
    return new Model({ step: 0, count: data.steps.length, name, label, width, ...shown(0) }, { answers: { step: shown } });
  }

  const buffers = (data) => data.buffers.map((text) => new DataView(bytesOf(text).buffer));

  function mesh(data) {
    return new Model(data.traits, {
      heard: (message, model) => message.kind === "ready" && model.trigger("msg:custom", { kind: "mesh" }, buffers(data)),
    });
  }

  function half(bits) {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023;
    const value = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
    return bits & 32768 ? -value : value;
  }

  /** Names and values of a Gaussian, from its packed row (viz/splat_rows.py). */
  function recordOf(view, { stride }, columns, row) {
    const at = row * stride, four = (v) => String(Number(v.toPrecision(4)));
    const floats = (from, count) => Array.from({ length: count }, (_, k) => view.getFloat32(at + from + 4 * k, true));
    const halves = (from, count) => Array.from({ length: count }, (_, k) => half(view.getUint16(at + from + 2 * k, true)));
    const quat = halves(12, 4), length = Math.hypot(...quat);
    const sh = halves(28 + 4 * columns.length, 3);
    const lines = [
      ["xyz_W [m]", floats(0, 3)], ["scale_m [m]", halves(20, 3).map(Math.exp)], ["quat (wxyz)", quat.map((q) => q / length)],
      ["rgb", sh.map((c) => 0.28209479177387814 * c + 0.5)], ["opacity", halves(26, 1)],
      ...floats(28, columns.length).map((value, k) => [columns[k].name, [value]]),
    ];
    return [["row", row.toLocaleString("en")], ...lines.map(([name, values]) => [name, values.map(four).join("  ")])];
  }

  function splat(data) {
    const [rows] = buffers(data);
    const picked = (row) => ({ record: row === null ? [] : recordOf(rows, data.head, data.traits.columns, row) });
    return new Model(data.traits, {
      answers: { picked },
      heard: (message, model) => message.kind === "ready" && model.trigger("msg:custom", { kind: "rows", head: data.head }, [rows]),
    });
  }

  const models = { stepper, mesh, splat, pixels: (data) => data, trace: (data, files) => ({ ...data, files }) };

  /** A recorded panel: controls beside a picture; each position has its own file. */
  class RecordedPanel {
    constructor(data, stage, folder) {
      Object.assign(this, { data, folder });
      this.at = Object.fromEntries(data.controls.map((c) => [c.name, c.start]));
      this.start = { ...this.at };
      this.grid = data.grids[0];
      this.image = Object.assign(document.createElement("img"), { className: "gsnb-recorded-image", alt: "" });
      this.words = Object.assign(document.createElement("div"), { className: "gsnb-recorded-words", tabIndex: 0 }); // it scrolls
      this.words.setAttribute("role", "group");
      this.words.setAttribute("aria-label", "words on the picture");
      this.words.setAttribute("aria-live", "polite");
      this.inputs = {};
      const side = document.createElement("div");
      side.className = "gsnb-recorded-side";
      for (const grid of data.grids) side.append(this.box(grid));
      const reset = Object.assign(document.createElement("button"), { type: "button", textContent: "Back to the start" });
      reset.addEventListener("click", () => this.reset());
      side.append(reset, this.words);
      const whole = document.createElement("div");
      whole.className = "gsnb-recorded";
      whole.setAttribute("role", "group");
      whole.setAttribute("aria-label", data.label ?? "recorded panel");
      whole.append(this.image, side);
      stage.replaceChildren(whole);
      if (data.click) {
        this.image.dataset.touch = "pixel";
        this.image.addEventListener("click", (event) => this.clicked(event));
      }
      this.show();
    }

    /** A click on a picture in the recorded one: the position that is next to it. */
    clicked(event) {
      const { controls, places, area: [left, top, right, bottom], size } = this.data.click;
      const box = this.image.getBoundingClientRect();
      const at = [
        (((event.clientX - box.left) / box.width - left) / (right - left)) * size[0],
        (((event.clientY - box.top) / box.height - top) / (bottom - top)) * size[1],
      ];
      if (at.some((x, k) => x < 0 || x >= size[k])) return;
      controls.forEach((name, axis) => {
        const away = places[axis].map((place) => Math.abs(place + 0.5 - at[axis]));
        this.at[name] = away.indexOf(Math.min(...away));
      });
      this.show();
    }

    box(grid) {
      const box = document.createElement("fieldset");
      const legend = document.createElement("legend");
      legend.textContent = grid.controls.map((name) => this.control(name).label).join(" and ");
      if (grid.controls.length > 1) box.append(legend);
      for (const name of grid.controls) box.append(this.row(grid, this.control(name)));
      return box;
    }

    control(name) {
      return this.data.controls.find((control) => control.name === name);
    }

    row(grid, control) {
      const label = document.createElement("label");
      label.append(Object.assign(document.createElement("span"), { textContent: control.label }));
      const output = document.createElement("output");
      let input;
      if (control.kind === "slider") {
        input = Object.assign(document.createElement("input"), { type: "range", min: 0, max: control.words.length - 1, step: 1 });
      } else {
        input = document.createElement("select");
        input.append(...control.words.map((words, k) => new Option(words, k)));
      }
      input.addEventListener("input", () => this.move(grid, control.name, Number(input.value)));
      label.append(input, ...(control.kind === "slider" ? [output] : []));
      (this.inputs[control.name] ??= []).push({ input, output, control });
      return label;
    }

    move(grid, name, to) {
      this.grid = grid;
      for (const other of Object.keys(this.at)) if (!grid.controls.includes(other)) this.at[other] = this.start[other];
      this.at[name] = to;
      this.show();
    }

    reset() {
      Object.assign(this.at, this.start);
      this.show();
    }

    address(place) {
      return `${this.folder}${this.data.grids.indexOf(this.grid)}_${place.join("_")}.webp`;
    }

    show() {
      const { counts, controls, captions, alts } = this.grid;
      const place = controls.map((name) => this.at[name]);
      const k = place.reduce((sum, at, axis) => sum * counts[axis] + at, 0);
      this.image.src = this.address(place);
      this.image.alt = alts[k];
      this.words.innerHTML = captions[k];
      for (const { input, output, control } of Object.values(this.inputs).flat()) {
        input.value = this.at[control.name];
        output.value = control.words[this.at[control.name]];
        if (control.kind === "slider") input.setAttribute("aria-valuetext", output.value);
      }
      place.forEach((at, axis) => {
        for (const next of [at - 1, at + 1]) {
          if (next < 0 || next >= counts[axis]) continue;
          new Image().src = this.address(place.map((other, a) => (a === axis ? next : other)));
        }
      });
    }
  }

  async function open(view) {
    const { kind, name, src, files } = view.dataset;
    const stage = view.querySelector(".gsnb-view-stage");
    if (view.dataset.state) return;
    view.dataset.state = "loading";
    try {
      const data = new Promise((resolve) => waiting.set(name, resolve));
      await load(src);
      const known = await data;
      if (kind === "panel") new RecordedPanel(known, stage, files);
      else {
        await load(`${root}front_${kind}.js`);
        stage.replaceChildren();
        window.gsnbFrontEnds[kind].render({ model: models[kind](known, files), el: stage });
        for (const code of stage.querySelectorAll(".gsnb-stepper-code")) code.tabIndex = 0; // it scrolls
      }
      view.dataset.state = "live";
    } catch (error) {
      view.dataset.state = "failed";
      console.error("a live view could not be opened:", error);
    }
  }

  const near = new IntersectionObserver((entries) => {
    for (const { isIntersecting, target } of entries) {
      if (!isIntersecting) continue;
      near.unobserve(target);
      open(target);
    }
  }, { rootMargin: "300px" });

  for (const view of document.querySelectorAll(".gsnb-view")) {
    const bytes = Number(view.dataset.bytes);
    if (bytes < LARGE) {
      near.observe(view);
      continue;
    }
    const words = `Make it live (${(bytes / 1e6).toFixed(1)} MB)`;
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: words });
    button.addEventListener("click", () => {
      button.remove();
      open(view);
    });
    view.querySelector(".gsnb-view-words").append(" ", button);
  }
})();
