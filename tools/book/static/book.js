// What reacts in the book's text: predictions before what came, quiz, and a button that copies code.
const store = (key, value) => {
  try {
    return value === undefined ? localStorage.getItem(key) : localStorage.setItem(key, value);
  } catch {
    return null; // a page opened from a file may have no storage
  }
};

/** Of choices that are numbers, the nearest one in ratio to what came. */
function rightChoice(came, choices) {
  if (came.dataset.right) return came.dataset.right;
  const value = parseFloat((came.textContent.match(/It came: ([^.]*(?:\.\d+)?)/)?.[1] ?? "").replace(/,/g, ""));
  const numbers = choices.filter((c) => Number(c) > 0);
  if (!(value > 0) || numbers.length !== choices.length) return null;
  return numbers.reduce((a, b) => (Math.abs(Math.log(b / value)) < Math.abs(Math.log(a / value)) ? b : a));
}

function verdictOn(form, came, answer) {
  const choices = [...form.querySelectorAll("input[type=radio]")].map((input) => input.value);
  const said = came.querySelector(".gsnb-outcome b")?.textContent ?? "";
  if (!choices.length) return `You predicted ${answer}. ${said}`;
  const right = rightChoice(came, choices);
  if (right === null) return `You predicted ${answer}. ${said}`;
  return right === answer ? `You predicted ${answer}: right. ${said}` : `You predicted ${answer}; right was ${right}. ${said}`;
}

function prepareQuestion(form) {
  const name = form.dataset.prediction;
  const later = [...document.querySelectorAll(`[data-prediction="${name}"]`)].filter((element) => element !== form);
  const came = later.find((element) => element.matches(".gsnb-came"));
  const status = form.querySelector("[role=status]");
  const show = (words) => {
    for (const element of later) element.classList.remove("gsnb-waiting");
    status.textContent = words;
    for (const button of form.querySelectorAll("button")) button.hidden = true;
    came?.querySelector(".gsnb-outcome")?.firstChild?.nodeType === 3 && (came.querySelector(".gsnb-outcome").firstChild.nodeValue = "");
  };
  const answered = store(`gsnb-prediction-${name}`);
  for (const element of later) element.classList.add("gsnb-waiting");
  if (answered !== null) {
    const input = form.querySelector(`input[type=radio][value="${CSS.escape(answered)}"]`) ?? form.querySelector("input[type=number]");
    if (input?.type === "radio") input.checked = true;
    else if (input) input.value = answered;
    show(came ? verdictOn(form, came, answered) : "");
  }
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const given = new FormData(form).get(name);
    if (!given) {
      status.textContent = "Choose an answer first.";
      return;
    }
    store(`gsnb-prediction-${name}`, given);
    show(came ? verdictOn(form, came, given) : "");
  });
  form.querySelector(".gsnb-skip").addEventListener("click", () => show(""));
}

function prepareQuiz(form) {
  form.addEventListener("change", ({ target }) => {
    const right = target.value === form.dataset.right;
    for (const label of form.querySelectorAll("label")) label.classList.remove("gsnb-chosen-right", "gsnb-chosen-wrong");
    target.closest("label").classList.add(right ? "gsnb-chosen-right" : "gsnb-chosen-wrong");
    const why = target.closest("label").dataset.why;
    form.querySelector("[role=status]").textContent = right ? "Right." : `Not this one. ${why}`;
    form.querySelector(".gsnb-said").hidden = !right;
  });
}

function addCopyButton(block) {
  if (!navigator.clipboard) return;
  const button = Object.assign(document.createElement("button"), { type: "button", className: "gsnb-copy", textContent: "Copy" });
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(block.querySelector("pre").innerText);
    button.textContent = "Copied";
    setTimeout(() => (button.textContent = "Copy"), 1500);
  });
  block.append(button);
}

/** A click on a heading of a table of results sorts its rows, the other way round at the next click. */
function addSorting(table) {
  const [heads, ...rows] = table.querySelectorAll("tr");
  const value = (row, k) => {
    const text = row.cells[k].textContent, number = parseFloat(text.replace(/,/g, ""));
    return Number.isNaN(number) ? text : number;
  };
  [...heads.cells].forEach((head, k) => {
    const button = Object.assign(document.createElement("button"), { type: "button", className: "gsnb-sort", textContent: head.textContent });
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const order = head.getAttribute("aria-sort") === "descending" ? "ascending" : "descending";
      for (const other of heads.cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", order);
      const sign = order === "ascending" ? 1 : -1;
      const compare = (a, b) => (a < b ? -sign : a > b ? sign : 0);
      rows.sort((a, b) => compare(value(a, k), value(b, k)));
      heads.after(...rows);
    });
  });
}

// Sphinx makes captions of lists of pages headings without a level.
for (const caption of document.querySelectorAll("p.caption[role=heading]:not([aria-level])")) caption.setAttribute("aria-level", "2");
document.querySelectorAll(".gsnb-question").forEach(prepareQuestion);
document.querySelectorAll("table.gsnb-lab-stored").forEach(addSorting);
document.querySelectorAll(".gsnb-quiz").forEach(prepareQuiz);
document.querySelectorAll("article .highlight").forEach(addCopyButton);
for (const block of document.querySelectorAll("article pre, article .table-wrapper")) if (block.scrollWidth > block.clientWidth) block.tabIndex = 0;
