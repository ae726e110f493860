// Mouse, touch and keys to movements of the camera. `view` has camera, focal, moved(), reset() and pick(x, y);
// if it has grabbed(down), that is told when the first button or finger goes down and when the last one goes up.

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const ZOOMS = { "+": 0.9, "=": 0.9, "-": 1.1 };

export function listenTo(scene, view) {
  const held = new Map(); // pointer -> where it is
  let travel = 0;
  scene.addEventListener("pointerdown", (e) => {
    scene.setPointerCapture(e.pointerId);
    if (!held.size) {
      travel = 0;
      view.grabbed?.(true);
    }
    held.set(e.pointerId, [e.clientX, e.clientY]);
  });
  scene.addEventListener("pointermove", (e) => {
    if (!held.has(e.pointerId)) return;
    const [x, y] = held.get(e.pointerId);
    travel += Math.abs(e.clientX - x) + Math.abs(e.clientY - y);
    const others = [...held].filter(([id]) => id !== e.pointerId);
    drag(e, [x, y], others[0]?.[1], scene.clientWidth, view);
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (travel >= 4) view.moved();
  });
  const release = (e) => {
    if (!held.delete(e.pointerId) || held.size) return;
    view.grabbed?.(false);
    scene.focus({ preventScroll: true }); // must come last: the notebook takes the focus when the button is pressed
    if (e.type === "pointerup" && travel < 4) view.pick(...place(e, scene));
  };
  scene.addEventListener("pointerup", release);
  scene.addEventListener("pointercancel", release);
  scene.addEventListener("dblclick", () => (view.aiming = true)); // the pick of the second click is not finished yet
  scene.addEventListener("wheel", (e) => wheel(e, scene, view), { passive: false });
  scene.addEventListener("keydown", (e) => key(e, view));
}

/** Position in the scene, as fractions of its size. */
function place(e, scene) {
  const box = scene.getBoundingClientRect();
  return [(e.clientX - box.left) / box.width, (e.clientY - box.top) / box.height];
}

function drag(e, [x, y], other, width, { camera, focal }) {
  const dx = e.clientX - x, dy = e.clientY - y;
  const turn = 4 / width; // radians per pixel: 4 across the picture
  if (other) {
    const apart = (px, py) => Math.hypot(px - other[0], py - other[1]);
    camera.zoom(apart(x, y) / Math.max(apart(e.clientX, e.clientY), 1));
    camera.pan(dx / 2, dy / 2, focal * width);
  } else if (e.shiftKey || e.buttons & 6) camera.pan(dx, dy, focal * width);
  else if (e.ctrlKey || e.metaKey) camera.look((dx * turn) / 2, (dy * turn) / 2);
  else camera.orbit(dx * turn, dy * turn);
}

function wheel(e, scene, view) {
  if (scene.getRootNode().activeElement !== scene && !e.ctrlKey) return; // otherwise the page could not be scrolled
  e.preventDefault();
  view.camera.zoom(Math.exp(Math.sign(e.deltaY) * Math.min(Math.abs(e.deltaY), 100) * 0.0015));
  view.moved();
}

function key(e, view) {
  const arrow = ARROWS[e.key];
  if (arrow && e.shiftKey) view.camera.pan(0.04 * arrow[0], 0.04 * arrow[1], view.focal);
  else if (arrow) view.camera.orbit(0.08 * arrow[0], 0.08 * arrow[1]);
  else if (ZOOMS[e.key]) view.camera.zoom(ZOOMS[e.key]);
  else if (["r", "R", "Home"].includes(e.key)) view.reset();
  else return;
  e.preventDefault();
  e.stopPropagation();
  view.moved();
}
