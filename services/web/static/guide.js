// docs/metrics.md as a page: headings, paragraphs and tables of the few forms that it has.
import { byId, element } from "./common.js";

const slug = (text) => text.toLowerCase().replace(/[^\w\- ]/g, "").replaceAll(" ", "-");

// Text with `code`; a link to another page of the docs is shown as its text.
function inline(text) {
  return text.split(/(`[^`]+`|\[[^\]]+\]\([^)]+\))/).map((piece) => {
    if (piece.startsWith("`")) return element("code", {}, piece.slice(1, -1));
    const link = piece.match(/^\[([^\]]+)\]\(/);
    return link ? link[1] : piece;
  });
}

const cells = (line) => line.replace(/^\||\|$/g, "").split("|").map((cell) => cell.trim());

let tables = 0;
function table(lines) {
  const [head, , ...rows] = lines;
  const row = (line, tag) => element("tr", {}, ...cells(line).map((cell) => element(tag, {}, ...inline(cell))));
  const made = element("table", {}, element("thead", {}, row(head, "td")), element("tbody", {}, ...rows.map((line) => row(line, "td"))));
  return element("div", { className: "scroll card", tabIndex: 0, role: "region", "aria-label": `Table ${(tables += 1)}` }, made);
}

function block(text) {
  const heading = text.match(/^(#+) (.*)$/);
  if (heading) return element(heading[1].length === 1 ? "h2" : heading[1].length === 2 ? "h2" : "h3", { id: slug(heading[2]) }, heading[2]);
  if (text.startsWith("|")) return table(text.split("\n"));
  return element("p", {}, ...inline(text.replaceAll("\n", " ")));
}

const text = await (await fetch("/metrics.md")).text();
const blocks = text.trim().replace(/^(#+ .*)$/gm, "\n$1\n").split(/\n\s*\n+/).map((piece) => piece.trim()).filter(Boolean);
byId("guide").replaceChildren(...blocks.map(block));
if (location.hash) document.getElementById(location.hash.slice(1))?.scrollIntoView();
