// Several runs side by side.
import { Axis, Chart, joined, withAxis } from "./chart.js";
import { FIGURES, columnsOf, derived } from "./figures.js";
import { byId, element, fetched, fill, leftBehind, number, param, percent, presetText, say, size, stateText } from "./common.js";

const MOST = 6;
const names = param("runs").split(",").filter(Boolean).slice(0, MOST);
const api = (name) => `/api/runs/${encodeURIComponent(name)}`;
// One curve a run, of these figures.
const SHOWN = [
  ["Success", "test", "Success in the test"],
  ["Success", "training", "Success in training, of the last 100 episodes"],
  ["Score of an episode", "score", "Score of an episode"],
  ["Loss", "loss", "Loss"],
  ["Pace", "robot_steps_per_s", "Robot steps a second"],
  ["Pace", "learner_steps_per_s", "Learner steps a second"],
];

const axis = new Axis(byId("axis"), () => load().catch((error) => say(error.message)));
const charts = SHOWN.map(([title, column, heading]) => {
  const figure = FIGURES.find((f) => f.title === title);
  const series = names.map((name, i) => ({ label: name, column: name, colour: i, points: column === "test" }));
  const about = { ...figure, title: heading, series };
  return [figure, column, new Chart(byId("charts"), about, (from, to, along) => along === "time" && axis.set({ from: Math.max(0, from), to }))];
});

async function load() {
  const stretch = `points=400&from=${axis.from}${axis.to === null ? "" : `&to=${axis.to}`}`;
  const tables = await Promise.all(names.map(async (name) => {
    const [history, episodes, tests] = await Promise.all(
      [`history?${stretch}`, `episodes?${stretch}`, "evaluations"].map((path) => fetched(`${api(name)}/${path}`)));
    axis.end = Math.max(axis.end, ...history.time_s.slice(-1));
    return derived(history, episodes, tests, { withAxis, joined }, axis.axis);
  }));
  for (const [figure, column, chart] of charts) {
    const each = tables.map((made, i) => {
      const columns = columnsOf(figure, made);
      return { x: columns.x, [names[i]]: columns[column] ?? columns.x.map(() => null) };
    });
    chart.draw(joined(each), axis.axis);
  }
}

function showResults(runs) {
  const best = (run) => run.state?.best;
  fill(
    byId("results"),
    [["run", (r) => element("a", { href: `/run?name=${encodeURIComponent(r.info.name)}` }, r.info.name)], ["state", (r) => stateText(r.info)],
      ["robots", (r) => number(r.info.robots), true], ["kind", (r) => r.info.kind], ["preset", (r) => presetText(r.info)],
      ["best success", (r) => percent(r.info.best_success, 1), true],
      ["95 % between", (r) => best(r)?.success_interval.map((share) => percent(share)).join(" and ")],
      ["learner steps", (r) => number(r.info.learner_steps), true], ["minutes", (r) => number(r.info.minutes), true], ["disk", (r) => size(r.info.disk_bytes), true]],
    runs,
  );
}

function showDifferences(runs) {
  const known = runs.filter((run) => run.settings);
  const values = new Map();
  for (const run of known) for (const s of run.settings.settings) values.set(s.key, [...(values.get(s.key) ?? []), s.value]);
  const differing = [...values].filter(([, of]) => new Set(of).size > 1);
  const columns = [["setting", ([key]) => element("code", {}, key)],
    ...known.map((run, i) => [run.info.name, ([, of]) => element("code", {}, of[i])])];
  fill(byId("differences"), columns, differing.length ? differing : [["none", known.map(() => "")]]);
}

async function start() {
  if (names.length < 2) throw new Error("Choose two runs or more, in the list of all runs.");
  const runs = await Promise.all(names.map((name) => fetched(api(name))));
  showResults(runs);
  showDifferences(runs);
  byId("files").replaceChildren(...runs.flatMap((run) => leftBehind(run.info.name, run.files).figures));
  await load();
}
start().catch((error) => say(error.message));
