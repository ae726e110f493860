// A line that is empty while the kernel lives. It also gives the sliders beside it their labels as names for screen readers:
// ipywidgets names the box around a slider but not the handle that has the focus.
import { whenLost } from "./lost.js";

function nameSliders(panel) {
  for (const slider of panel.querySelectorAll(".widget-slider")) {
    const name = slider.querySelector(".widget-label")?.textContent;
    const handle = slider.querySelector(".noUi-handle");
    if (name && handle) handle.setAttribute("aria-label", name);
  }
}

export default {
  render({ model, el }) {
    el.setAttribute("role", "status");
    el.classList.add("gsnb-lost");
    const forget = whenLost(model, el, (words) => (el.textContent = words));
    const later = [0, 500, 3000].map((ms) =>
      setTimeout(() => nameSliders(el.closest(".jp-OutputArea-output, .jupyter-widgets") ?? el), ms),
    );
    return () => {
      forget();
      later.forEach(clearTimeout);
    };
  },
};
