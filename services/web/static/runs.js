// The list of runs.
import { ago, byId, element, fetched, fill, number, percent, presetText, say, size, stateClass, stateText } from "./common.js";

const PERIOD_MS = 5000;
const MOST = 6;
const chosen = new Set();

function choose(name) {
  const box = element("input", { type: "checkbox", checked: chosen.has(name), "aria-label": `compare ${name}` });
  box.addEventListener("change", () => {
    if (box.checked && chosen.size >= MOST) box.checked = false;
    (box.checked ? chosen.add(name) : chosen.delete(name));
    tell();
  });
  return box;
}

function tell() {
  byId("chosen").textContent = chosen.size ? `${[...chosen].join(", ")} (at most ${MOST})` : "none chosen";
  byId("compare").querySelector("button").disabled = chosen.size < 2;
}

const COLUMNS = [
  ["compare", (run) => choose(run.name)],
  ["name", (run) => element("a", { href: `/run?name=${encodeURIComponent(run.name)}` }, run.name)],
  ["state", (run) => element("span", { className: stateClass(run) }, stateText(run))],
  ["robots", (run) => number(run.robots), true],
  ["kind", (run) => run.kind],
  ["preset", presetText],
  ["best success", (run) => percent(run.best_success, 1), true],
  ["learner steps", (run) => number(run.learner_steps), true],
  ["minutes", (run) => number(run.minutes), true],
  ["disk", (run) => size(run.disk_bytes), true],
  ["active", (run) => ago(run.active_s)],
];

let shown = "";

async function refresh() {
  try {
    const told = await fetched("/api/runs");
    say(told.runs.length ? "" : `There are no runs in ${told.folder} yet. mrcdrl train starts one.`);
    byId("where").textContent = `in ${told.folder}`;
    const now = JSON.stringify(told.runs);
    if (now !== shown && !byId("runs").contains(document.activeElement)) {
      shown = now;
      fill(byId("runs"), COLUMNS, told.runs);
    }
  } catch (error) {
    say(`The server does not answer (${error.message}); trying again.`);
  }
  setTimeout(refresh, document.hidden ? 4 * PERIOD_MS : PERIOD_MS);
}

byId("compare").addEventListener("submit", (event) => {
  event.preventDefault();
  location.href = `/compare?runs=${[...chosen].map(encodeURIComponent).join(",")}`;
});
refresh();
