// Curves, drawn by uPlot: all charts of a page share their axis and their zoom.
import { byId, element, number } from "./common.js";

const SECONDS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400, 172800, 604800];

const style = () => getComputedStyle(document.documentElement);
const colour = (name) => style().getPropertyValue(`--${name}`).trim();

// {title, text, link, unit, log, series: [{label, column, band}]}; columns come with `draw`.
export class Chart {
  constructor(place, about, onZoom) {
    this.about = about;
    this.onZoom = onZoom;
    this.columns = null;
    this.now = element("p", { className: "now small" });
    this.holder = element("div", { className: "plot", role: "img", "aria-label": `${about.title}: no values yet` });
    const more = element("a", { href: `/guide#${about.link}`, "aria-label": `More on ${about.title}` }, "more");
    const explained = element("p", { className: "small quiet" }, `${about.text} `, more);
    const caption = element("figcaption", {}, element("h3", {}, about.title), explained, this.now);
    place.append(element("figure", { className: "card" }, caption, this.holder));
    new ResizeObserver(() => this.#fit()).observe(this.holder);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#rebuild());
  }

  // columns: {x: [...], COLUMN: [...]}; axis: "time" (seconds) or "steps".
  draw(columns, axis) {
    const { series } = this.about;
    const before = this.plot?.data;
    this.columns = [columns.x, ...series.map(({ column }) => columns[column] ?? columns.x.map(() => null))];
    if (this.about.log) this.columns = this.columns.map((c, i) => (i ? c.map((v) => (v > 0 ? v : null)) : c));
    if (!this.plot || axis !== this.axis || before.length !== this.columns.length) {
      this.axis = axis;
      this.#rebuild();
    } else {
      this.plot.setData(this.columns);
    }
    this.#tell();
  }

  #tell() {
    const last = (values) => values.findLast((value) => value !== null && value !== undefined);
    const { unit = "", series, title } = this.about;
    const parts = series
      .filter(({ quiet }) => !quiet)
      .map(({ label }, i) => [label, last(this.columns[1 + series.findIndex((s) => s.label === label)])])
      .filter(([, value]) => value !== undefined)
      .map(([label, value]) => `${label} ${number(value)}${unit}`);
    const text = parts.length ? parts.join(" · ") : "no values yet";
    this.now.textContent = text;
    this.holder.setAttribute("aria-label", `${title}, latest values: ${text}`);
  }

  #width() {
    return Math.max(200, this.holder.clientWidth);
  }

  #height() {
    return Math.round(Math.min(420, Math.max(180, 0.42 * this.#width())));
  }

  #fit() {
    if (this.plot && Math.abs(this.plot.width - this.#width()) > 1) {
      this.plot.setSize({ width: this.#width(), height: this.#height() });
    }
  }

  #rebuild() {
    if (!this.columns) return;
    this.plot?.destroy();
    const pixels = parseFloat(style().fontSize);
    const font = `${Math.round(0.75 * pixels)}px system-ui, sans-serif`;
    const axes = { stroke: colour("quiet"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") }, font };
    const inTime = this.axis === "time";
    const across = (_, values) => values.map((v) => (inTime ? clock(v) : number(v)));
    const bands = this.about.series.flatMap(({ band }, i) =>
      band ? [{ series: [i + 1, i + 2], fill: `${colour(`s${band.colour}`)}33` }] : []);
    const options = {
      width: this.#width(),
      height: this.#height(),
      pxAlign: false,
      scales: { x: { time: false }, y: { distr: this.about.log ? 3 : 1, range: this.about.range } },
      axes: [
        { ...axes, values: across, incrs: inTime ? SECONDS : undefined, size: 2.4 * pixels, space: 5 * pixels },
        { ...axes, size: 4 * pixels, values: (_, values) => values.map((v) => (v === null ? "" : number(v))) },
      ],
      series: [
        { label: inTime ? "time" : "learner steps", value: (_, v) => (v === null ? "–" : inTime ? clock(v) : number(v)) },
        ...this.about.series.map((s, i) => ({
          label: s.label,
          class: s.quiet ? "hidden" : undefined,
          stroke: s.quiet ? "transparent" : colour(`s${s.colour ?? i}`),
          width: s.quiet ? 0 : 2,
          dash: s.dash,
          spanGaps: true,
          points: { show: s.points ?? false, size: 6 },
          value: (_, v) => number(v) + (v === null ? "" : this.about.unit ?? ""),
        })),
      ],
      bands,
      cursor: { drag: { x: true, y: false, setScale: false }, sync: { key: "run" } },
      hooks: { setSelect: [(plot) => this.#zoom(plot)] },
    };
    this.plot = new uPlot(options, this.columns, this.holder);
  }

  #zoom(plot) {
    if (plot.select.width < 5) return;
    const from = plot.posToVal(plot.select.left, "x");
    const to = plot.posToVal(plot.select.left + plot.select.width, "x");
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.onZoom(from, to, this.axis);
  }
}

export function clock(seconds) {
  const whole = Math.round(seconds);
  const [hours, minutes, rest] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return `${hours}:${String(minutes).padStart(2, "0")}:${String(rest).padStart(2, "0")}`;
}

// The buttons above the curves. Calls `changed({axis, from, to})`; times in seconds of the run.
export class Axis {
  constructor(place, changed) {
    this.axis = "time";
    this.from = 0;
    this.to = null; // null: as the run goes on
    this.changed = changed;
    this.buttons = {};
    const group = element("span", { role: "group", "aria-label": "Axis" });
    for (const [axis, text] of [["time", "over time"], ["steps", "over learner steps"]]) {
      this.buttons[axis] = element("button", { type: "button" }, text);
      this.buttons[axis].addEventListener("click", () => this.set({ axis }));
      group.append(this.buttons[axis]);
    }
    const zoom = element("span", { role: "group", "aria-label": "Stretch of the run" });
    for (const [text, make] of [
      ["whole run", () => ({ from: 0, to: null })],
      ["last 10 min", (end) => ({ from: Math.max(0, end - 600), to: null })],
      ["zoom in", (end) => this.#scaled(end, 0.5)],
      ["zoom out", (end) => this.#scaled(end, 2)],
      ["earlier", (end) => this.#moved(end, -0.5)],
      ["later", (end) => this.#moved(end, 0.5)],
    ]) {
      const button = element("button", { type: "button" }, text);
      button.addEventListener("click", () => this.set(make(this.end)));
      zoom.append(button, " ");
    }
    this.told = element("span", { className: "quiet", role: "status" });
    place.append(group, zoom, this.told);
    this.end = 0;
    this.#show();
  }

  set(values) {
    Object.assign(this, values);
    this.#show();
    this.changed();
  }

  #scaled(end, factor) {
    const to = this.to ?? end;
    const half = Math.max(5, (factor * (to - this.from)) / 2);
    const middle = (this.from + to) / 2;
    const [from, upTo] = [Math.max(0, middle - half), middle + half];
    return { from, to: upTo >= end ? null : upTo };
  }

  #moved(end, by) {
    const to = this.to ?? end;
    const span = to - this.from;
    const from = Math.max(0, Math.min(end - span, this.from + by * span));
    return { from, to: from + span >= end ? null : from + span };
  }

  #show() {
    for (const [axis, button] of Object.entries(this.buttons)) {
      button.setAttribute("aria-pressed", String(axis === this.axis));
    }
    const open = this.to === null;
    this.told.textContent = this.from === 0 && open ? "the whole run" : `${clock(this.from)} to ${open ? "the end" : clock(this.to)}`;
  }
}

// Joins tables that have each their own x into one set of columns.
export function joined(tables) {
  const filled = tables.filter((table) => table.x.length);
  if (!filled.length) return { x: [] };
  const names = filled.map((table) => Object.keys(table).filter((name) => name !== "x"));
  const data = uPlot.join(filled.map((table, i) => [table.x, ...names[i].map((name) => table[name])]));
  return Object.fromEntries([["x", data[0]], ...names.flat().map((name, i) => [name, data[i + 1]])]);
}

// Columns of a server's answer with x in place: seconds, or learner steps (which never fall, here).
export function withAxis(columns, axis) {
  const key = axis === "time" ? "time_s" : "learner_steps";
  const keep = [];
  let latest = -Infinity;
  (columns[key] ?? []).forEach((value, i) => {
    if (value !== null && value > latest) {
      latest = value;
      keep.push(i);
    }
  });
  const picked = Object.entries(columns).map(([name, values]) => [name, keep.map((i) => values[i])]);
  return { ...Object.fromEntries(picked), x: keep.map((i) => columns[key][i]) };
}
