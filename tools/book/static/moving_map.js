// A map that turns by itself until it is touched: the splat viewer of the notebooks without a kernel.
// moving_map.py puts the viewer's modules (VIEWER, OrbitCamera), its style (STYLE) and the map (STATE, HEAD, ROWS) before this text.
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

for (const place of document.querySelectorAll(".gsnb-moving-map")) {
  document.head.append(Object.assign(document.createElement("style"), { textContent: STYLE }));
  const model = new StoredModel(STATE, HEAD, Uint8Array.from(atob(ROWS), (letter) => letter.charCodeAt(0)).buffer);
  // behind the poster until there is a picture
  const poster = place.querySelector("img"), stage = place.appendChild(document.createElement("div"));
  stage.className = "gsnb-moving-map-waiting";
  VIEWER.render({ model, el: stage });
  const drawn = new MutationObserver(() => {
    if (!stage.querySelector(".gsnb-splat-status")?.textContent.includes("in view")) return;
    drawn.disconnect();
    poster?.remove();
    stage.className = "";
    place.classList.add("gsnb-moving-map-live");
  });
  drawn.observe(stage, { subtree: true, childList: true, characterData: true });
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const turning = setInterval(() => {
    if (document.hidden || still) return;
    const camera = new OrbitCamera(model.get("pose"), model.get("pivot_m"), model.get("up_W"));
    camera.turn(camera.up, (TURN_DEG * Math.PI) / 180, camera.pivot);
    model.set("pose", camera.pose());
  }, FRAME_MS);
  for (const touch of ["pointerdown", "wheel", "keydown"]) place.addEventListener(touch, () => clearInterval(turning), { capture: true, passive: true });
}
