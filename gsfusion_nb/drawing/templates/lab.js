const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const [budget, scene, ruleA, ruleB, viewMenu] = ["budget", "scene", "rule-a", "rule-b", "view"].map($);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

function make(tag, attributes = {}, ...children) {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(...children);
  return element;
}
const image = (number, alt) => make("img", { src: data.pictures[number], alt });
const titled = (picture, words) => make("figure", {}, picture, make("figcaption", {}, words));

// Pictures of a rule at the chosen budget and scene; the ranks of all scenes show those of the first.
function shotsOf(label) {
  const place = scene.value || scene.options[0].value;
  return data.shots.find((s) => s.label === label && s.scene === place && s.budget === budget.value);
}

function showTable() {
  document.querySelectorAll(".one-table").forEach((table) => {
    table.hidden = table.dataset.budget !== budget.value || table.dataset.scene !== scene.value;
  });
  closeRule();
  showComparison();
}

function openRule(label, row) {
  closeRule();
  const shots = shotsOf(label);
  const panel = $("of-rule");
  const words = shots?.views.length ? `${label}: ${shots.scene}, ${shots.budget}, seed ${shots.seed}` : `${label}: no pictures`;
  panel.querySelector("h3").textContent = words;
  panel.querySelector(".shots").replaceChildren(
    ...(shots?.views ?? []).flatMap((v) => [
      titled(image(v.truth, `View ${v.name} as recorded`), `view ${v.name}, recorded`),
      titled(image(v.render, `View ${v.name} as rendered by ${label}`), `${label}`),
      titled(image(v.error, `Error of ${label} in view ${v.name}`), "error: black is none, light yellow is 25 % or more"),
    ]),
  );
  panel.hidden = false;
  row.classList.add("chosen");
  row.querySelector("button").setAttribute("aria-expanded", "true");
  panel.returnTo = row.querySelector("button");
  ruleA.value = label;
  if (ruleB.value === label) ruleB.selectedIndex = (ruleB.selectedIndex + 1) % ruleB.options.length;
  showComparison();
}

function closeRule() {
  $("of-rule").hidden = true;
  document.querySelectorAll("tr.chosen").forEach((row) => {
    row.classList.remove("chosen");
    row.querySelector("button").setAttribute("aria-expanded", "false");
  });
}

// One side of the comparison: a rule, or the recorded picture of the other side's view.
function side(menu, other) {
  if (menu.value) {
    const shot = shotsOf(menu.value)?.views.find((v) => v.name === viewMenu.value);
    return shot && { label: menu.value, picture: shot.render, error: shot.error, truth: shot.truth };
  }
  const shot = shotsOf(other.value)?.views.find((v) => v.name === viewMenu.value);
  return shot && { label: "recorded picture", picture: shot.truth, error: null, truth: shot.truth };
}

function listViews() {
  const names = (shotsOf(ruleA.value) ?? shotsOf(ruleB.value))?.views.map((v) => v.name) ?? [];
  const before = viewMenu.value;
  viewMenu.replaceChildren(...names.map((name) => make("option", {}, name)));
  if (names.includes(before)) viewMenu.value = before;
}

let flicker = 0;
function showComparison() {
  clearInterval(flicker);
  listViews();
  const [a, b] = [side(ruleA, ruleB), side(ruleB, ruleA)];
  const found = data.sentences.find(
    ([of, p, q]) => of === budget.value && [p, q].includes(ruleA.value) && [p, q].includes(ruleB.value) && p !== q,
  );
  $("verdict").textContent = found && ruleA.value !== ruleB.value ? `${found[3]}.` : "";
  if (!a || !b) {
    $("comparison").replaceChildren(make("p", { className: "missing" }, "These two have no pictures of a common view."));
    return;
  }
  const mode = document.querySelector("input[name=mode]:checked").value;
  $("comparison").replaceChildren(...MODES[mode](a, b));
}

function tags(a, b) {
  return [make("span", { className: "tag a" }, a.label), make("span", { className: "tag b" }, b.label)];
}

const MODES = {
  slider(a, b) {
    const over = make("div", { className: "over" }, image(b.picture, `Rendered by ${b.label}`));
    const line = make("div", { className: "line" });
    const stage = make("div", { className: "stage" }, image(a.picture, `Rendered by ${a.label}`), over, line, ...tags(a, b));
    const range = make("input", { type: "range", id: "divide", min: 0, max: 100, value: 50 });
    const move = () => {
      over.style.clipPath = `inset(0 0 0 ${range.value}%)`;
      line.style.left = `calc(${range.value}% - 1px)`;
    };
    const drag = (event) => {
      const box = stage.getBoundingClientRect();
      range.value = (100 * (event.clientX - box.left)) / box.width;
      move();
    };
    stage.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      stage.setPointerCapture(event.pointerId);
      drag(event);
    });
    stage.addEventListener("pointermove", (event) => event.buttons & 1 && drag(event));
    range.addEventListener("input", move);
    move();
    return [stage, make("div", { className: "under" }, make("label", { htmlFor: "divide" }, "Dividing line"), range)];
  },

  flicker(a, b) {
    const over = make("div", { className: "over" }, image(b.picture, `Rendered by ${b.label}`));
    const tag = make("span", { className: "tag a" });
    const show = (second) => {
      over.hidden = !second;
      tag.textContent = second ? b.label : a.label;
    };
    const run = make("button", { type: "button", className: "press" });
    const swap = make("button", { type: "button", className: "press" }, "Swap");
    const play = (on) => {
      clearInterval(flicker);
      flicker = on ? setInterval(() => show(over.hidden), 700) : 0;
      run.textContent = on ? "Pause" : "Play";
    };
    run.addEventListener("click", () => play(!flicker));
    swap.addEventListener("click", () => {
      play(false);
      show(over.hidden);
    });
    show(false);
    play(!still);
    const stage = make("div", { className: "stage" }, image(a.picture, `Rendered by ${a.label}`), over, tag);
    return [stage, make("div", { className: "under" }, run, swap)];
  },

  side: (a, b) => [
    make(
      "div",
      { className: "pair" },
      titled(image(a.picture, `Rendered by ${a.label}`), a.label),
      titled(image(b.picture, `Rendered by ${b.label}`), b.label),
      titled(image(a.truth, "As recorded"), "recorded"),
    ),
  ],

  error: (a, b) => [
    make(
      "div",
      { className: "pair" },
      ...[a, b].map((s) =>
        s.error === null
          ? make("p", { className: "missing" }, "The recorded picture has no error.")
          : titled(image(s.error, `Error of ${s.label}`), `error of ${s.label}`),
      ),
    ),
    $("error-bar").content.cloneNode(true),
  ],

  nearer(a, b) {
    const canvas = make("canvas", { width: 1, height: 1 });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Where ${a.label} or ${b.label} is nearer to the recorded picture`);
    Promise.all([a.picture, b.picture, a.truth].map(pixels)).then(([p, q, truth]) => drawNearer(canvas, p, q, truth));
    const key = (colour, words) => {
      const box = make("i");
      box.style.background = colour;
      return make("span", {}, box, words);
    };
    return [
      make("div", { className: "stage" }, canvas),
      make("div", { className: "keys" }, key("#3d85c6", `${a.label} is nearer`), key("#e08a2e", `${b.label} is nearer`)),
    ];
  },
};

async function pixels(number) {
  const picture = image(number, "");
  await picture.decode();
  const canvas = make("canvas", { width: picture.naturalWidth, height: picture.naturalHeight });
  const context = canvas.getContext("2d");
  context.drawImage(picture, 0, 0);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

// Blue where a is nearer to the truth, orange where b is; full colour at a difference of a tenth of the range.
function drawNearer(canvas, a, b, truth) {
  [canvas.width, canvas.height] = [truth.width, truth.height];
  const shown = new ImageData(truth.width, truth.height);
  for (let i = 0; i < truth.data.length; i += 4) {
    let gain = 0;
    for (let c = i; c < i + 3; c++) gain += Math.abs(b.data[c] - truth.data[c]) - Math.abs(a.data[c] - truth.data[c]);
    const share = Math.min(Math.abs(gain) / 77, 1);
    const colour = gain > 0 ? [61, 133, 198] : [224, 138, 46];
    colour.forEach((value, c) => (shown.data[i + c] = 24 + share * (value - 24)));
    shown.data[i + 3] = 255;
  }
  canvas.getContext("2d").putImageData(shown, 0, 0);
}

document.querySelectorAll("table.sortable").forEach(makeSortable);
document.querySelectorAll("[data-needs-script]").forEach((part) => (part.hidden = false));
document.querySelectorAll(".sortable:not(.ranks) tbody tr").forEach((row) => {
  row.querySelector("button").setAttribute("aria-expanded", "false");
  row.addEventListener("click", () => (row.classList.contains("chosen") ? closeRule() : openRule(row.dataset.label, row)));
});
$("close").addEventListener("click", () => {
  const row = $("of-rule").returnTo;
  closeRule();
  row?.focus();
});
[budget, scene].forEach((menu) => menu.addEventListener("change", showTable));
[ruleA, ruleB, viewMenu].forEach((menu) => menu.addEventListener("change", showComparison));
document.querySelectorAll("input[name=mode]").forEach((mode) => mode.addEventListener("change", showComparison));
if (ruleB.options.length > 2) ruleB.selectedIndex = 1;
showTable();
