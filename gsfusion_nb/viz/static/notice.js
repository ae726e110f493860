// A line that is empty while the kernel lives.
import { whenLost } from "./lost.js";

export default {
  render({ model, el }) {
    el.setAttribute("role", "status");
    el.classList.add("gsnb-lost");
    return whenLost(model, el, (words) => (el.textContent = words));
  },
};
