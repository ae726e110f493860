// A map that turns by itself until it is touched: the splat viewer of the notebooks without a kernel.
// page_map.py puts the viewer's modules (VIEWER, OrbitCamera) before this text. A page has the viewer's style sheet, and
// the data of each map in a script element, or one map for all places in a constant (MAP).
const FRAME_MS = 60;
const TURN_DEG = 0.6; // per picture

/** What the viewer takes for the widget's model: it answers "ready" with the rows of the map. */
class StoredModel {
  constructor(state, head, rows) {
    Object.assign(this, { state, head, rows, heard: new Map() });
  }

  get(name) {
    return this.state[name];
  }

  set(name, value) {
    const values = typeof name === "string" ? { [name]: value } : name;
    for (const [key, now] of Object.entries(values)) {
      const before = this.state[key];
      this.state[key] = now;
      if (before !== now) this.tell(`change:${key}`);
    }
  }

  on(event, act) {
    this.heard.set(event, [...(this.heard.get(event) ?? []), act]);
  }

  off(event, act) {
    this.heard.set(event, (this.heard.get(event) ?? []).filter((known) => known !== act));
  }

  tell(event, ...what) {
    for (const act of this.heard.get(event) ?? []) act(...what);
  }

  save_changes() {}

  send(message) {
    if (message.kind === "ready") setTimeout(() => this.tell("msg:custom", { kind: "rows", head: this.head }, [new DataView(this.rows)]));
  }
}

/** The records of a map: deflated, and all first bytes before all second ones. */
async function recordsOf({ head, rows }) {
  const packed = Uint8Array.from(atob(rows), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const { n, stride } = head, records = new Uint8Array(n * stride);
  for (let k = 0; k < stride; k++) for (let row = 0, at = k * n; row < n; row++) records[row * stride + k] = planes[at + row];
  return records.buffer;
}

/** The poster and its disabled buttons stay until there is a picture; where something is missing in the browser, the poster stays for good. */
async function showMap(place, map) {
  const model = new StoredModel(map.state, map.head, await recordsOf(map));
  const still = place.querySelectorAll("img, .gsnb-moving-map-soon"), stage = place.appendChild(document.createElement("div"));
  stage.className = "gsnb-moving-map-waiting";
  VIEWER.render({ model, el: stage });
  const drawn = new MutationObserver(() => {
    if (!stage.querySelector(".gsnb-splat-status")?.textContent.includes("in view")) return;
    drawn.disconnect();
    for (const part of still) part.remove();
    stage.className = "";
    place.classList.add("gsnb-moving-map-live");
  });
  drawn.observe(stage, { subtree: true, childList: true, characterData: true });
  foldControls(stage);
  turn(place, model);
}

/** Only where to look from, and how the map grew; a button shows the others. */
function foldControls(stage) {
  const more = Object.assign(document.createElement("button"), { type: "button", textContent: "more" });
  more.addEventListener("click", () => {
    const isFolded = stage.firstElementChild.classList.toggle("gsnb-splat-all");
    more.textContent = isFolded ? "fewer" : "more";
  });
  stage.querySelector(".gsnb-splat-places").append(more);
}

/** Turn the map until it is touched; `data-turns` times around, for ever without it. */
function turn(place, model) {
  if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
  let left = place.dataset.turns ? (Number(place.dataset.turns) * 360) / TURN_DEG : Infinity;
  const turning = setInterval(() => {
    if (document.hidden || !place.matches(".gsnb-moving-map-live")) return;
    if (--left < 0) return clearInterval(turning);
    const camera = new OrbitCamera(model.get("pose"), model.get("pivot_m"), model.get("up_W"));
    camera.turn(camera.up, (TURN_DEG * Math.PI) / 180, camera.pivot);
    model.set("pose", camera.pose());
  }, FRAME_MS);
  for (const touch of ["pointerdown", "wheel", "keydown"]) place.addEventListener(touch, () => clearInterval(turning), { capture: true, passive: true });
}

for (const place of document.querySelectorAll(".gsnb-moving-map")) {
  const own = place.querySelector('script[type="application/json"]');
  showMap(place, own ? JSON.parse(own.textContent) : MAP).catch((error) => {
    place.querySelector(".gsnb-moving-map-soon")?.remove();
    console.warn("the map stays a picture:", error);
  });
}
