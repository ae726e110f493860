{% include "sortable.js" %}
const STYLE = `.gsnb-lab-table{overflow-x:auto;max-width:100%}
.gsnb-lab-table table{border-collapse:collapse;font-variant-numeric:tabular-nums;color:inherit}
.gsnb-lab-table th,.gsnb-lab-table td{padding:4px 10px;text-align:right;border-bottom:1px solid rgba(128,128,128,.35);
white-space:nowrap;color:inherit;background:none}
.gsnb-lab-table th:first-child{text-align:left}
.gsnb-lab-table thead th{white-space:normal;min-width:76px;vertical-align:bottom}
.gsnb-lab-table button{all:unset;cursor:pointer;font-weight:600}
.gsnb-lab-table button:focus-visible{outline:2px solid #3d85c6;outline-offset:2px}
.gsnb-lab-table thead button::after{content:"\\202f\\2195";opacity:.35}
.gsnb-lab-table [aria-sort=descending] button::after{content:"\\202f\\2193";opacity:1}
.gsnb-lab-table [aria-sort=ascending] button::after{content:"\\202f\\2191";opacity:1}
.gsnb-lab-table tbody tr{cursor:pointer}
.gsnb-lab-table tbody tr:hover,.gsnb-lab-table tr.chosen{background:rgba(61,133,198,.18)}
.gsnb-lab-table .sd,.gsnb-lab-table .state{opacity:.72;font-size:.86em}`;

function make(tag, attributes = {}, ...children) {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(...children);
  return element;
}

function cellOf({ mean, sd, place, value }) {
  const tag = ["span", "b", "u"][place];
  const cell = make("td", {}, make(tag, {}, mean));
  if (sd) cell.append(make("span", { className: "sd" }, ` ± ${sd}`));
  if (value !== null) cell.dataset.value = value;
  return cell;
}

// A table whose content comes from Python; it keeps its order while rows change.
function render({ model, el }) {
  const table = make("table", {}, make("caption", { style: "text-align:left;opacity:.72" }));
  const draw = () => {
    const { title, heads, rows } = model.get("content");
    const before = table.tHead && [...table.tHead.rows[0].cells];
    const sorted = before?.findIndex((head) => head.hasAttribute("aria-sort")) ?? -1;
    const [name, up] = sorted < 0 ? ["", false] : [before[sorted].textContent, before[sorted].ariaSort === "ascending"];
    const focused = table.contains(document.activeElement) ? document.activeElement.textContent : null;
    const head = make("tr", {}, ...heads.map((h) => headOf(h)));
    const body = rows.map(rowOf);
    table.replaceChildren(table.caption, make("thead", {}, head), make("tbody", {}, ...body));
    table.caption.textContent = title;
    const sort = makeSortable(table);
    const again = heads.findIndex((h) => h.name === name);
    if (again >= 0) sort(again, up);
    if (focused !== null) [...table.querySelectorAll("button")].find((b) => b.textContent === focused)?.focus();
  };
  const headOf = ({ name, better }) => {
    const cell = make("th", { scope: "col" }, make("button", { type: "button" }, name));
    cell.dataset.better = better;
    return cell;
  };
  const rowOf = ({ label, state, cells }) => {
    const chosen = label === model.get("selected");
    const button = make("button", { type: "button" }, label);
    button.setAttribute("aria-pressed", chosen);
    const head = make("th", { scope: "row" }, button, make("span", { className: "state" }, ` ${state}`));
    const row = make("tr", { className: chosen ? "chosen" : "" }, head, ...cells.map(cellOf));
    row.addEventListener("click", () => {
      model.set("selected", chosen ? "" : label);
      model.save_changes();
    });
    return row;
  };
  model.on("change:content", draw);
  model.on("change:selected", draw);
  draw();
  el.append(make("style", {}, STYLE), make("div", { className: "gsnb-lab-table" }, table));
  return () => model.off(null, draw);
}
export default { render };
