// The page of one run.
import { ArenaView, isWorld } from "./arena.js";
import { Axis, Chart, joined, withAxis } from "./chart.js";
import { FIGURES, columnsOf, derived } from "./figures.js";
import { byId, duration, element, fetched, fill, leftBehind, number, param, percent, presetText, say, stateClass, stateText } from "./common.js";

const name = param("name");
const api = `/api/runs/${encodeURIComponent(name)}`;
const POINTS = 600;
const POLL_MS = 4000;

let about = null; // what `api` said last
let state = null; // of the run now
let source = null; // of events
let tables = { history: {}, episodes: {}, tests: [] };
let watched = ""; // role/worker; empty until frames come of the first actor, which the server finds
let seenEvaluations = -1;

const LEGEND_OF_A_WORLD = "The world as its agents see it: the newest picture of each, in grey as their network gets it.";
const arena = new ArenaView();
const axis = new Axis(byId("axis"), () => load());
const zoom = (from, to, along) => {
  if (along === "time") axis.set({ from: Math.max(0, from), to });
  else axis.set(inTime(from, to));
};
const charts = FIGURES.map((figure) => [figure, new Chart(byId("charts"), figure, zoom)]);

function inTime(from, to) {
  const { time_s: times, learner_steps: steps } = tables.history;
  const at = (value) => times[Math.max(0, steps.findIndex((step) => step >= value))] ?? 0;
  return { from: at(from), to: at(to) || null };
}

// -- from records ------------------------------------------------------------------------

async function load() {
  const stretch = `points=${POINTS}&from=${axis.from}${axis.to === null ? "" : `&to=${axis.to}`}`;
  const [history, episodes, tests] = await Promise.all(
    [`history?${stretch}`, `episodes?${stretch}`, "evaluations"].map((path) => fetched(`${api}/${path}`)),
  );
  const end = axis.to ?? Infinity;
  tables = { history, episodes, tests: tests.filter((t) => t.time_s >= axis.from && t.time_s <= end) };
  axis.end = Math.max(axis.end, ...history.time_s.slice(-1));
  draw();
}

function draw() {
  const made = derived(tables.history, tables.episodes, tables.tests, { withAxis, joined }, axis.axis);
  for (const [figure, chart] of charts) chart.draw(columnsOf(figure, made), axis.axis);
}

// A second of the run that is up, added to the curves.
function append(point) {
  if (axis.to !== null || !tables.history.time_s) return;
  axis.end = point.time_s;
  if (tables.history.time_s.length > 2 * POINTS) {
    load().catch(() => {});
    return;
  }
  for (const [column, values] of Object.entries(tables.history)) values.push(point[column] ?? null);
  draw();
}

async function refreshAbout() {
  try {
    about = await fetched(api);
    say("");
    showInfo();
    const up = about.info.state === "running";
    if (!up || !state) show(about.state);
    byId("live").classList.toggle("hidden", !up);
    if (up && !source && !document.hidden) listen();
  } catch (error) {
    say(`${error.message}. Trying again …`);
  }
}

function showInfo() {
  const { info, settings, files } = about;
  document.title = `${info.name} · mrcdrl`;
  byId("name").textContent = info.name;
  byId("state").textContent = stateText(info);
  byId("state").className = `chip ${stateClass(info)}`;
  byId("about").textContent = [
    info.robots ? `${info.robots} robot${info.robots === 1 ? "" : "s"}` : "", info.kind, `preset ${presetText(info)}`, info.stop_reason,
  ].filter(Boolean).join(" · ");
  if (settings) {
    arena.configure(settings.arena);
    if (isWorld(settings.arena)) byId("legend").textContent = LEGEND_OF_A_WORLD;
    showSettings(settings);
  } else {
    say("The settings of this run are of another version of mrcdrl: only its curves can be shown.");
  }
  showFiles(info.name, files);
}

let filesShown = "";
function showFiles(run, files) {
  if (filesShown === files.join()) return;
  filesShown = files.join();
  const { figures, links } = leftBehind(run, files);
  const list = element("p", {}, "Files: ", ...links.flatMap((link) => [link, " "]));
  byId("files").replaceChildren(...figures, list);
}

let settingsShown = "";
function showSettings({ preset, settings }) {
  const all = byId("all-settings").checked;
  if (settingsShown === `${all}${settings.length}`) return;
  settingsShown = `${all}${settings.length}`;
  const changed = settings.filter((setting) => setting.there !== null);
  byId("preset").textContent = `${changed.length} of ${settings.length} differ from the preset ${preset}`;
  fill(
    byId("settings"),
    [["setting", (s) => element("code", {}, s.key)], ["here", (s) => element("code", {}, s.value)],
      [`preset ${preset}`, (s) => (s.there === null ? "the same" : element("code", {}, s.there))], ["meaning", (s) => s.meaning]],
    all ? settings : changed,
    (line, s) => { if (s.there !== null) line.className = "differs"; },
  );
}
byId("all-settings").addEventListener("change", () => about?.settings && showSettings(about.settings));

// -- live --------------------------------------------------------------------------------

function listen() {
  source?.close();
  const [role, worker] = watched.split("/");
  const query = watched ? `role=${encodeURIComponent(role)}&worker=${encodeURIComponent(worker)}` : "role=actor";
  const opened = new EventSource(`${api}/live?${query}`);
  source = opened;
  let told = false; // of a run that is up
  opened.addEventListener("state", (event) => {
    told = true;
    say("");
    show(JSON.parse(event.data));
    append(state.point);
  });
  opened.addEventListener("frame", (event) => {
    const frame = JSON.parse(event.data);
    const from = `${frame.role}/${frame.worker}`;
    if (!watched) byId("worker").value = watched = from;
    if (from === watched) arena.add(frame);
  });
  opened.addEventListener("waiting", (event) => say(`Waiting for the run: ${JSON.parse(event.data).why}`));
  opened.addEventListener("refused", (event) => { say(event.data); stop(opened); });
  opened.addEventListener("ended", () => {
    stop(opened);
    if (!told) return;
    refreshAbout();
    load().catch(() => {});
  });
  opened.onerror = () => {
    if (source !== opened) return;
    say("The server does not answer; trying again …");
    if (opened.readyState === EventSource.CLOSED) stop(opened);
  };
}

function stop(opened) {
  opened?.close();
  if (source === opened) source = null;
}

document.addEventListener("visibilitychange", () => {
  if (document.hidden) {
    stop(source);
  } else {
    refreshAbout();
    load().catch(() => {});
  }
});

// -- what is shown of a state --------------------------------------------------------------

function show(told) {
  if (!told) return;
  state = told;
  const up = about?.info.state === "running";
  byId("lead").textContent = lead(told, up);
  showTiles(told, up);
  showServices(told, up);
  showWorkers(told);
  showTests(told);
  if (told.evaluations.length !== seenEvaluations && seenEvaluations >= 0 && axis.to === null) load().catch(() => {});
  seenEvaluations = told.evaluations.length;
}

function lead(told, up) {
  const info = about?.info ?? {};
  const one = info.robots === 1;
  const who = about?.settings && isWorld(about.settings.arena) ? "agent" : "robot";
  const many = one ? `One ${who} learns` : `${info.robots ?? "Some"} ${who}s learn`;
  const aim = who === "agent" ? "to act in a custom world" : `to reach ${one ? "a target" : "a target each"} without touching anything`;
  const what = `${many} ${aim}, from what ${one ? "it sees" : "each of them sees"}.`;
  const best = told.best
    ? `The best weights so far reached ${percent(told.best.success_rate)} success in the test.`
    : "No test has come to its end yet.";
  if (!up) return `${what} The run has ended${info.stop_reason ? `: ${info.stop_reason}` : ""}. ${best}`;
  return `${what} It is now ${told.doing}. ${best}`;
}

function tile(term, figure, text, link) {
  return element(
    "div", { className: text.length > 90 ? "card wide" : "card" },
    element("dt", {}, term),
    element("dd", { className: "figure" }, figure),
    element("dd", { className: "small quiet" }, `${text} `, element("a", { href: `/guide#${link}`, "aria-label": `More on ${term}` }, "more")),
  );
}

let tilesShown = "";
function showTiles(told, up) {
  const { last, best, point } = told;
  const [successes, of] = told.recent_successes;
  const interval = (e) => (e ? `between ${percent(e.success_interval[0])} and ${percent(e.success_interval[1])} with 95 % certainty, of ${e.episodes} episodes` : "");
  const epsilon = point.epsilon_min === point.epsilon_max ? number(point.epsilon_max) : `${number(point.epsilon_min)} to ${number(point.epsilon_max)}`;
  const tiles = [
    ["Success in the test", percent(last?.success_rate, 1), last ? `${interval(last)}. Best so far: ${percent(best.success_rate, 1)}.` : "The first test is still to come: the newest weights then play episodes with few random actions, always from the same starts.", "evaluationsjsonl"],
    ["Success in training", of ? percent(successes / of) : "–", `of the last ${of} episodes, random actions included.`, "episodesjsonl"],
    [up ? "What holds it back" : "What held it back", up && told.waiting ? "–" : told.limited_by, told.waiting ? told.doing : told.why, "mrcdrl-status---json"],
    ["Time", duration(point.time_s), told.time_left_s === null ? `of the run${told.time_since === "the run began" ? "" : ` ${told.time_since}`}.` : `so far; ${duration(told.time_left_s)} left.`, "metricsjsonl"],
    ["Learner steps", number(point.learner_steps), `${number(point.learner_steps_per_s)} a second; weights v${told.weights_version}.`, "learner"],
    ["Robot steps", number(point.robot_steps), `${number(point.robot_steps_per_s)} a second, in ${number(point.episodes)} episodes.`, "actor"],
    ["Random actions (ε)", epsilon, "share of actions that are random, to try things.", "actor"],
    ["Score", number(told.recent_score), "rewards of an episode, mean of the last 100.", "episodesjsonl"],
    ["Loss", number(point.loss), `TD error: half below ${number(point.td_error_p50)}, 99 % below ${number(point.td_error_p99)}.`, "learner"],
    ["Replay", `${percent(told.replay_size / told.replay_capacity)}`, `filled: ${number(told.replay_size)} of ${number(told.replay_capacity)} steps; each is learned from ${number(point.samples_per_insert)} times.`, "replay"],
    ["Weights in use", `${number(point.staleness_versions)} behind`, `the stalest actor's are ${number(point.staleness_s)} s old.`, "metricsjsonl"],
  ];
  const byRobots = Object.entries(told.success_by_robots ?? {});
  if (byRobots.length > 1) tiles.splice(1, 0, ["By number of robots", byRobots.map(([n, rate]) => `${n}: ${percent(rate)}`).join(", "), "success in the last tests.", "evaluationsjsonl"]);
  if (tilesShown === JSON.stringify(tiles) || byId("tiles").contains(document.activeElement)) return;
  tilesShown = JSON.stringify(tiles);
  byId("tiles").replaceChildren(...tiles.map((t) => tile(...t)), histogram(told));
}

// Where action values lie: ten classes, from below the least possible return to above the greatest.
function histogram(told) {
  const bins = told.histograms.q_bin;
  const term = element("dt", {}, "Action values (Q), of the last seconds");
  const more = element("a", { href: "/guide#learner", "aria-label": "More on action values" }, "more");
  if (!bins) return element("div", { className: "card" }, term, element("dd", { className: "small quiet" }, "none yet ", more));
  const reach = about?.settings?.largest_return ?? 1;
  const edges = [-1, -0.75, -0.5, -0.25, 0, 0.25, 0.5, 0.75, 1].map((edge) => number(edge * reach, 2));
  const rows = element("dd", { className: "bins" });
  bins.forEach((share, i) => {
    const fillBar = element("div", { className: "fill" });
    fillBar.style.width = `${Math.max(0, Math.min(100, 100 * share))}%`;
    const label = i === 0 ? `below ${edges[0]}` : i === 9 ? `from ${edges[8]}` : `${edges[i - 1]} … ${edges[i]}`;
    rows.append(element("span", {}, label), element("span", { className: "track", "aria-hidden": "true" }, fillBar), element("span", {}, percent(share)));
  });
  return element("div", { className: "card wide" }, term, rows, element("dd", { className: "small quiet" }, "what the network expects of its actions; nothing should lie in the first or last class. ", more));
}

function showServices(told, up) {
  const since = (ns) => {
    const ms = Number(ns) / 1e6;
    return Number.isFinite(ms) && ms > 1e12 && ms < 1e13 ? new Date(ms).toLocaleString() : "–";
  };
  const rows = told.more_services ? [...told.services, { role: "…", id: `and ${told.more_services} more`, figures: "" }] : told.services;
  fill(
    byId("services"),
    [["process", (s) => (s.id.startsWith(s.role) ? s.id : `${s.role} ${s.id}`)],
      ["state", (s) => (up ? element("span", { className: s.well ? "good" : "bad" }, s.presence ?? "") : "")],
      ["started", (s) => since(s.since_ns)],
      ["weights", (s) => (s.stale_versions === null || s.stale_versions === undefined ? "" : `${s.stale_versions} behind, ${number(s.stale_s)} s old`)],
      ["does", (s) => s.figures]],
    rows,
  );
}

function showTests(told) {
  const best = told.best;
  fill(
    byId("tests"),
    [["after", (t) => duration(t.time_s), true], ["weights", (t) => `v${t.weights_version}`, true], ["robots", (t) => number(t.num_robots), true],
      ["success", (t) => `${percent(t.success_rate, 1)}${best && t.time_s === best.time_s ? " ★ best" : ""}`, true],
      ["95 % between", (t) => t.success_interval.map((share) => percent(share)).join(" and ")],
      ["collision", (t) => percent(t.collision_rate, 1), true], ["out of time", (t) => percent(t.timeout_rate, 1), true],
      ["episodes", (t) => number(t.episodes), true], ["frames to success", (t) => number(t.mean_frames), true]],
    [...told.evaluations].reverse().slice(0, 15),
  );
}

function showWorkers(told) {
  const select = byId("worker");
  const workers = told.services.filter((s) => s.watchable).map((s) => [`${s.role}/${s.id}`, `${s.role} ${s.id}`]);
  if ([...select.options].map((o) => o.value).join() !== workers.map(([value]) => value).join()) {
    select.replaceChildren(...workers.map(([value, text]) => element("option", { value }, text)));
  }
  // An actor plays all the time, an evaluator now and then.
  const first = workers.find(([value]) => value.startsWith("actor/")) ?? workers[0];
  const coming = !watched && first?.[0].startsWith("actor/"); // its frames are asked for already
  if (first && !coming && !workers.some(([value]) => value === watched)) watch(first[0]);
  select.value = watched;
}

function watch(which) {
  if (which === watched) return;
  watched = which;
  arena.clear();
  if (source) listen();
}
byId("worker").addEventListener("change", () => watch(byId("worker").value));

// -- log -----------------------------------------------------------------------------------

let logShown = "";
async function refreshLog() {
  const lines = await fetched(`${api}/log`).catch(() => []);
  const own = (state?.log ?? []).map((text) => ({ time: "", level: "WARNING", worker: "run", text }));
  const wanted = byId("warnings").checked ? [...lines.filter((l) => l.level !== "INFO"), ...own] : [...lines, ...own];
  if (JSON.stringify(wanted) === logShown) return;
  logShown = JSON.stringify(wanted);
  const place = byId("log");
  const atEnd = place.scrollTop + place.clientHeight >= place.scrollHeight - 20;
  const items = wanted.map((l) => element("li", { className: { WARNING: "warn", ERROR: "bad" }[l.level] ?? "" }, `${l.time} ${l.level === "INFO" ? "" : `${l.level} `}${l.worker}: ${l.text}`));
  place.replaceChildren(...(items.length ? items : [element("li", { className: "quiet" }, "No log lines here. In containers, logs are kept by the engine.")]));
  if (atEnd) place.scrollTop = place.scrollHeight;
}
byId("warnings").addEventListener("change", refreshLog);

async function poll() {
  if (!document.hidden) await Promise.all([refreshAbout(), refreshLog()]);
  setTimeout(poll, POLL_MS);
}
// The arena first: curves take the server longer.
if (!document.hidden) listen();
poll().then(load).catch(() => {});
