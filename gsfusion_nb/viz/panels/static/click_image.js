// A picture that reports which of its pixels was clicked, dragged over, or reached with the arrow keys.
function render({ model, el }) {
  const image = document.createElement("img");
  image.className = "gsnb-click-image";
  image.draggable = false;
  image.tabIndex = 0;
  image.style.cssText = "display:block;max-width:100%;cursor:crosshair;touch-action:none;image-rendering:pixelated";
  let url = "";
  const draw = () => {
    const data = model.get("value");
    URL.revokeObjectURL(url);
    url = URL.createObjectURL(new Blob([data], { type: `image/${model.get("format")}` }));
    image.src = url;
    image.width = model.get("width");
    image.alt = model.get("alt");
  };
  const choose = (u, v) => {
    const [columns, rows] = model.get("size");
    const pixel = [Math.min(Math.max(u, 0), columns - 1), Math.min(Math.max(v, 0), rows - 1)];
    const before = model.get("pixel");
    if (before[0] === pixel[0] && before[1] === pixel[1]) return;
    model.set("pixel", pixel);
    model.save_changes();
  };
  const point = (event) => {
    const box = image.getBoundingClientRect();
    const [columns, rows] = model.get("size");
    const u = ((event.clientX - box.left) / box.width) * columns;
    const v = ((event.clientY - box.top) / box.height) * rows;
    choose(Math.floor(u), Math.floor(v));
  };
  image.addEventListener("pointerdown", (event) => {
    image.focus({ preventScroll: true });
    image.setPointerCapture(event.pointerId);
    point(event);
  });
  image.addEventListener("pointermove", (event) => {
    if (event.buttons & 1) point(event);
  });
  const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  image.addEventListener("keydown", (event) => {
    const move = moves[event.key];
    if (!move) return;
    event.preventDefault();
    event.stopPropagation();
    const [u, v] = model.get("pixel");
    choose(u + move[0], v + move[1]);
  });
  for (const name of ["value", "width", "alt"]) model.on(`change:${name}`, draw);
  draw();
  el.appendChild(image);
  return () => URL.revokeObjectURL(url);
}
export default { render };
