// A stepper: picture, line of code and numbers of one step; Next, Back, Restart, a slider over all steps, arrow keys.
const LAYOUT = `
  <div class="gsnb-stepper-left">
    <img class="gsnb-stepper-image">
    <div class="gsnb-stepper-bar">
      <button type="button" class="jp-Button jupyter-button gsnb-stepper-restart" title="to the first step (Home)">Restart</button>
      <button type="button" class="jp-Button jupyter-button gsnb-stepper-back" title="one step back (left arrow)">Back</button>
      <button type="button" class="jp-Button jupyter-button mod-primary gsnb-stepper-next" title="the next step (right arrow)">Next</button>
      <input type="range" min="0" step="1" class="gsnb-stepper-slider" aria-label="step">
      <output class="gsnb-stepper-count"></output>
    </div>
  </div>
  <div class="gsnb-stepper-right">
    <div class="gsnb-stepper-title" aria-live="polite"></div>
    <div class="gsnb-stepper-code"></div>
    <div class="gsnb-stepper-numbers"></div>
  </div>`;

function render({ model, el }) {
  const root = document.createElement("div");
  root.className = `gsnb-stepper gsnb-stepper-${model.get("name")}`;
  root.tabIndex = 0;
  root.setAttribute("role", "group");
  root.setAttribute("aria-label", `${model.get("label")}. Arrow keys: next step, one step back.`);
  root.innerHTML = LAYOUT;
  const part = (name) => root.querySelector(`.gsnb-stepper-${name}`);
  const image = part("image"), slider = part("slider");
  const last = model.get("count") - 1;
  slider.max = last;
  image.width = model.get("width");
  let url = "";
  const show = () => {
    URL.revokeObjectURL(url);
    url = URL.createObjectURL(new Blob([model.get("png")], { type: "image/png" }));
    image.src = url;
    image.alt = model.get("alt");
    part("title").innerHTML = model.get("title");
    part("code").innerHTML = model.get("code");
    part("numbers").innerHTML = model.get("numbers");
    const line = part("code").querySelector("mark");
    if (line) part("code").scrollTop = Math.max(0, line.offsetTop - part("code").offsetTop - 60);
  };
  const place = () => {
    const step = model.get("step");
    slider.value = step;
    slider.setAttribute("aria-valuetext", `step ${step + 1} of ${last + 1}`);
    part("count").value = `${step + 1} of ${last + 1}`;
    part("back").disabled = part("restart").disabled = step === 0;
    part("next").disabled = step === last;
  };
  const go = (step) => {
    const to = Math.min(Math.max(step, 0), last);
    if (to === model.get("step")) return;
    model.set("step", to);
    model.save_changes();
  };
  part("next").addEventListener("click", () => go(model.get("step") + 1));
  part("back").addEventListener("click", () => go(model.get("step") - 1));
  part("restart").addEventListener("click", () => go(0));
  slider.addEventListener("input", () => go(Number(slider.value)));
  const keys = { ArrowRight: () => model.get("step") + 1, ArrowLeft: () => model.get("step") - 1, Home: () => 0, End: () => last };
  root.addEventListener("keydown", (event) => {
    const to = keys[event.key];
    if (!to) return;
    event.preventDefault();
    event.stopPropagation();
    go(to());
  });
  model.on("change:step", place);
  model.on("change:shown", show);
  place();
  show();
  el.appendChild(root);
  return () => {
    model.off("change:step", place);
    model.off("change:shown", show);
    URL.revokeObjectURL(url);
  };
}
export default { render };
