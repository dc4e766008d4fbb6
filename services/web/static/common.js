// What all pages share: data from the server, text in its place, tables, numbers in words.
// Whatever comes from a run is set as text, never as markup.

export const param = (name) => new URLSearchParams(location.search).get(name) ?? "";

export async function fetched(path) {
  const answer = await fetch(path, { headers: { Accept: "application/json" } });
  if (!answer.ok) throw new Error((await answer.text()).trim() || `the server answers ${answer.status}`);
  return answer.json();
}

export const byId = (id) => document.getElementById(id);

export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function say(text) {
  const place = byId("message");
  place.textContent = text;
  place.classList.toggle("hidden", !text);
}

export const UNKNOWN = "–";

export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return UNKNOWN;
  const size = Math.abs(value);
  if (size >= 1e15) return value.toExponential(1);
  if (size >= 1000) return Math.round(value).toLocaleString("en").replaceAll(",", "\u202f");
  return String(Number(value.toPrecision(digits)));
}

export const percent = (share, digits = 0) =>
  share === null || share === undefined ? UNKNOWN : `${(100 * share).toFixed(digits)} %`;

export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return UNKNOWN;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 1) return `${Math.round(seconds)} s`;
  if (minutes < 60) return `${minutes} min`;
  return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

export function size(bytes) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let at = 0;
  while (bytes >= 1000 && at < units.length - 1) [bytes, at] = [bytes / 1000, at + 1];
  return `${number(bytes)} ${units[at]}`;
}

export function ago(epochSeconds) {
  const passed = Date.now() / 1000 - epochSeconds;
  return passed < 60 ? "now" : `${duration(passed)} ago`;
}

// Columns: [heading, cell of a row (text or node), whether it is a number].
export function fill(table, columns, rows, decorate = () => {}) {
  const head = element("tr");
  for (const [heading, , isNumber] of columns) {
    head.append(element("th", { scope: "col", className: isNumber ? "number" : "" }, heading));
  }
  table.tHead.replaceChildren(head);
  table.tBodies[0].replaceChildren(
    ...rows.map((row) => {
      const line = element("tr");
      for (const [, cell, isNumber] of columns) {
        line.append(element("td", { className: isNumber ? "number" : "" }, cell(row) ?? UNKNOWN));
      }
      decorate(line, row);
      return line;
    }),
  );
}

const WORDS = {
  running: ["running", "good"], ended: ["ended", ""], stopped: ["stopped", "warn"],
  failed: ["failed", "bad"], killed: ["killed", "bad"],
};

export function stateText(info) {
  const [word] = WORDS[info.state] ?? [info.state];
  return info.rule ? `${word} (${info.rule})` : word;
}

export const stateClass = (info) => (WORDS[info.state] ?? ["", ""])[1];

export function presetText(info) {
  if (!info.preset) return UNKNOWN;
  return info.changed ? `${info.preset} +${info.changed}` : info.preset;
}

// What a run has left to look at, as figures.
export function leftBehind(name, files) {
  const address = (file) => `/files/${encodeURIComponent(name)}/${file}`;
  const shown = [
    ["evaluation.mp4", "Film of test episodes, with what the robots saw"],
    ["training.png", "Training: scores, successes of 100 episodes, tests"],
    ["trajectories.png", "Paths of test episodes"],
  ].filter(([file]) => files.includes(file));
  const figures = shown.map(([file, text]) => {
    const picture = file.endsWith(".mp4")
      ? element("video", { src: address(file), controls: true, preload: "metadata", "aria-label": `${text}, ${name}` })
      : element("img", { src: address(file), alt: `${text}, ${name}`, loading: "lazy" });
    return element("figure", { className: "card" }, picture, element("figcaption", { className: "small" }, `${text} · ${name}`));
  });
  return { figures, links: files.map((file) => element("a", { href: address(file) }, file)) };
}
