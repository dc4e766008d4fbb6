// The arena on one canvas: frames as they come, kept for a while to pause, step and slow down.
import { byId, element, number } from "./common.js";

const RATE = 15; // frames a second
const KEPT = 1200; // frames
const LATE = 30; // frames behind, from which what comes is caught up with
const TRAIL = 120; // frames
const COLOURS = ["#ffffff", "#7fd99a", "#f5c26b", "#c9a7ff", "#6fd6de", "#ff9d94", "#d6e685", "#f7a8d8", "#9fc2ff", "#d9c9b0"];
const OUTCOMES = { success: "success: every robot is on a target", collision: "over: too many collisions", timeout: "over: out of time" };
const WORLD_OUTCOMES = { success: "success", collision: "over, without success", timeout: "over: out of time" };

// Whether it is a custom world, which has pictures and no lengths.
export const isWorld = (arena) => arena.kind === "custom";

export class ArenaView {
  constructor() {
    this.canvas = byId("arena-canvas");
    this.context = this.canvas.getContext("2d");
    this.frames = [];
    this.place = -1; // of the frame shown, fractional while it plays
    this.playing = true;
    this.drawn = null;
    this.said = "";
    this.times = []; // of the frames that came, in ms
    this.held = null; // what is about to be moved: {thing, index}
    byId("play").addEventListener("click", () => this.#play(!this.playing));
    byId("back").addEventListener("click", () => this.#step(-1));
    byId("forward").addEventListener("click", () => this.#step(1));
    byId("newest").addEventListener("click", () => { this.place = this.frames.length - 1; this.#play(true); });
    byId("trails").addEventListener("change", () => { this.drawn = null; });
    this.canvas.addEventListener("keydown", (event) => {
      const does = { " ": () => this.#play(!this.playing), ArrowLeft: () => this.#step(-1), ArrowRight: () => this.#step(1) }[event.key];
      if (does) { event.preventDefault(); does(); }
    });
    this.last = performance.now();
    requestAnimationFrame((now) => this.#tick(now));
  }

  // arena: of the run's settings; of a custom world the agents' pictures are shown.
  configure(arena) {
    this.arena = arena;
    byId("trails").parentElement.hidden = isWorld(arena);
  }

  clear() {
    this.frames = [];
    this.place = -1;
    this.drawn = null;
    this.told = null;
  }

  async add(frame) {
    const place = this.frames.push(frame) - 1;
    this.times.push(performance.now());
    if (this.times.length > RATE) this.times.shift();
    if (this.place < 0) this.place = place;
    if (this.frames.length > KEPT) {
      this.frames.shift();
      this.place = Math.max(0, this.place - 1);
    }
    frame.pixels = frame.images ? await inflated(frame.images) : null;
    this.drawn = null;
  }

  // A place on the canvas, in px of the arena.
  placeOf(event) {
    const box = this.canvas.getBoundingClientRect();
    const scale = this.arena.size / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  }

  // The robot or target at a place of the frame shown; null if there is none.
  thingAt([x, y]) {
    if (!this.drawn) return null;
    const near = (list, reach) => list.findIndex(([a, b]) => Math.hypot(a - x, b - y) <= reach);
    const robot = near(this.drawn.robots, this.arena.robot_radius);
    if (robot >= 0) return { thing: "robot", index: robot };
    const target = near(this.drawn.targets, Math.max(this.arena.target_size, 22));
    return target >= 0 ? { thing: "target", index: target } : null;
  }

  // Frames that came in the last second.
  get rate() {
    const now = performance.now();
    return this.times.filter((time) => now - time < 1000).length;
  }

  #play(playing) {
    this.playing = playing;
    byId("play").textContent = playing ? "Pause" : "Play";
  }

  #step(by) {
    this.#play(false);
    this.place = Math.max(0, Math.min(this.frames.length - 1, Math.floor(this.place) + by));
  }

  #tick(now) {
    const passed = Math.min(0.2, (now - this.last) / 1000);
    this.last = now;
    const newest = this.frames.length - 1;
    if (this.playing && newest >= 0) {
      const speed = Number(byId("speed").value);
      const behind = newest - this.place;
      const hurry = speed === 1 && behind > 3 ? 1.15 : 1;
      this.place = speed === 1 && behind > LATE ? newest - 2 : Math.min(newest, this.place + passed * RATE * speed * hurry);
    }
    const shown = this.frames[Math.floor(this.place)];
    if (shown && this.arena && shown !== this.drawn) {
      this.drawn = shown;
      this.#draw(shown, Math.floor(this.place));
    }
    requestAnimationFrame((next) => this.#tick(next));
  }

  #draw(frame, place) {
    const arena = this.arena;
    const side = Math.round(this.canvas.clientWidth * devicePixelRatio) || 600;
    if (this.canvas.width !== side) this.canvas.width = this.canvas.height = side;
    if (isWorld(arena)) this.#drawPictures(frame, side);
    else this.#drawArena(frame, place, side);
    this.#tell(frame, place);
    this.#drawRobots(frame, place);
  }

  // A custom world: the newest picture of each agent, side by side.
  #drawPictures(frame, side) {
    const c = this.context;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = "#000";
    c.fillRect(0, 0, side, side);
    const count = frame.robots.length;
    const across = Math.ceil(Math.sqrt(count));
    const cell = side / across;
    const gap = count > 1 ? cell / 50 : 0;
    const pixels = frame.view_px ** 2;
    const picture = document.createElement("canvas");
    c.imageSmoothingEnabled = false;
    for (let agent = 0; agent < count && frame.pixels; agent += 1) {
      drawViews(picture, [frame.pixels.subarray(agent * pixels, (agent + 1) * pixels)], frame.view_px);
      const [x, y] = [(agent % across) * cell, Math.floor(agent / across) * cell];
      c.strokeStyle = COLOURS[agent % COLOURS.length];
      c.lineWidth = gap;
      if (gap) c.strokeRect(x + gap / 2, y + gap / 2, cell - gap, cell - gap);
      c.drawImage(picture, x + gap, y + gap, cell - 2 * gap, cell - 2 * gap);
    }
  }

  #drawArena(frame, place, side) {
    const arena = this.arena;
    const scale = side / arena.size;
    const c = this.context;
    c.setTransform(scale, 0, 0, scale, 0, 0);
    c.fillStyle = "#000";
    c.fillRect(0, 0, arena.size, arena.size);
    c.strokeStyle = "#e5484d";
    c.lineWidth = Math.max(arena.wall_thickness, 1.2 / scale);
    const edge = arena.wall_offset + arena.wall_thickness / 2;
    c.strokeRect(edge, edge, arena.size - 2 * edge, arena.size - 2 * edge);
    for (const [x0, y0, x1, y1] of arena.inner_walls) line(c, x0, y0, x1, y1);
    c.fillStyle = "#35b86b";
    for (const [x, y, radius] of frame.obstacles) disc(c, x, y, radius);
    c.fillStyle = "#4c8dff";
    const half = arena.target_size / 2;
    for (const [x, y] of frame.targets) c.fillRect(x - half, y - half, 2 * half, 2 * half);
    if (byId("trails").checked) this.#drawTrails(frame, place, scale);
    frame.robots.forEach(([x, y, heading], robot) => {
      const radius = arena.robot_radius;
      c.fillStyle = COLOURS[robot % COLOURS.length];
      disc(c, x, y, radius);
      c.strokeStyle = "#000";
      c.lineWidth = Math.max(3, 2 / scale);
      line(c, x, y, x + radius * Math.cos(heading), y + radius * Math.sin(heading));
      if (frame.collided[robot]) {
        c.strokeStyle = "#ff3b30";
        c.lineWidth = 5;
        c.beginPath();
        c.arc(x, y, radius + 5, 0, 2 * Math.PI);
        c.stroke();
      }
      c.fillStyle = "#000";
      c.font = `bold ${0.9 * radius}px sans-serif`;
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.fillText(String(robot + 1), x - 0.35 * radius * Math.cos(heading), y - 0.35 * radius * Math.sin(heading));
    });
    const held = this.held && frame[`${this.held.thing}s`][this.held.index];
    if (held) {
      c.strokeStyle = "#ffd54a";
      c.lineWidth = 3;
      c.beginPath();
      c.arc(held[0], held[1], arena.robot_radius + 9, 0, 2 * Math.PI);
      c.stroke();
    }
    if (frame.outcome) {
      c.strokeStyle = frame.outcome === "success" ? "#35d07a" : "#ff3b30";
      c.lineWidth = 12;
      c.strokeRect(6, 6, arena.size - 12, arena.size - 12);
    }
  }

  #drawTrails(frame, place, scale) {
    const c = this.context;
    c.lineWidth = 2.5 / Math.min(1, scale);
    c.globalAlpha = 0.55;
    frame.robots.forEach((_, robot) => {
      c.strokeStyle = COLOURS[robot % COLOURS.length];
      c.beginPath();
      for (let i = place; i > Math.max(-1, place - TRAIL) && this.#follows(i, frame, place); i -= 1) {
        const [x, y] = this.frames[i].robots[robot];
        if (i === place) c.moveTo(x, y);
        else c.lineTo(x, y);
      }
      c.stroke();
    });
    c.globalAlpha = 1;
  }

  // Whether frame i is of the same episode as `frame`, and the frames between are all there.
  #follows(i, frame, place) {
    const other = this.frames[i];
    return other.episode === frame.episode && other.frame === frame.frame - (place - i);
  }

  #tell(frame, place) {
    const words = [
      `${frame.role} ${frame.worker}`, `arena ${frame.arena}`, `episode ${frame.episode}`, `frame ${frame.frame}`,
      `weights v${frame.weights_version}`, `ε ${number(frame.epsilon)}`,
      `${this.frames.length - 1 - place} frames behind the newest`, `${this.rate} frames/s`,
    ];
    byId("moment").textContent = words.join(" · ");
    const hits = frame.collided.map((hit, robot) => (hit ? robot + 1 : 0)).filter(Boolean);
    const custom = isWorld(this.arena);
    const ending = (custom ? WORLD_OUTCOMES : OUTCOMES)[frame.outcome] ?? "";
    const said = ending ? `Episode ${frame.episode}: ${ending}.` : this.said;
    if (said !== this.said) byId("ending").textContent = this.said = said;
    const shows = custom
      ? `The world, as its ${frame.robots.length} agents see it`
      : `The arena: ${frame.robots.length} robots, ${frame.targets.length} targets, ${frame.obstacles.length} obstacles`;
    const label = `${shows}; frame ${frame.frame} of episode ${frame.episode}${hits.length ? `; robot ${hits.join(", ")} collided` : ""}${ending ? `; ${ending}` : ""}`;
    if (!this.told || performance.now() - this.told > 2000 || ending) {
      this.canvas.setAttribute("aria-label", label);
      this.told = performance.now();
    }
    this.canvas.title = "Space: pause or play; arrows: step";
  }

  #drawRobots(frame, place) {
    const holder = byId("robots");
    while (holder.children.length > frame.robots.length) holder.lastChild.remove();
    while (holder.children.length < frame.robots.length) holder.append(robotPanel(holder.children.length, this.arena));
    frame.robots.forEach((_, robot) => {
      const panel = holder.children[robot];
      drawViews(panel.querySelector("canvas"), this.#stack(frame, place, robot), frame.view_px);
      drawValues(panel, frame.q_values[robot], frame.actions[robot], this.arena);
    });
  }

  // The newest images of a robot, oldest first, as its network sees them.
  #stack(frame, place, robot) {
    const size = frame.view_px ** 2;
    const images = [];
    for (let back = this.arena.stack - 1; back >= 0; back -= 1) {
      const wanted = Math.max(0, frame.frame - back); // an episode's first image is repeated
      const i = place - (frame.frame - wanted);
      const source = i >= 0 && this.#follows(i, frame, place) ? this.frames[i] : null;
      images.push(source?.pixels?.subarray(robot * size, (robot + 1) * size) ?? null);
    }
    return images;
  }
}

function robotPanel(robot, arena) {
  const name = `${isWorld(arena) ? "Agent" : "Robot"} ${robot + 1}`;
  const swatch = element("span", { className: "swatch", "aria-hidden": "true" });
  swatch.style.background = COLOURS[robot % COLOURS.length];
  const values = element("div", { className: "q" });
  for (const action of arena.actions) {
    const track = element("span", { className: "track", "aria-hidden": "true" }, element("div", { className: "fill" }));
    values.append(element("span", {}, action), track, element("output", {}, "–"));
  }
  const picture = element("canvas", { role: "img", "aria-label": `What ${name.toLowerCase()} sees: its last images, oldest first` });
  return element(
    "section", { className: "robot card", "aria-label": name },
    element("h3", {}, swatch, ` ${name}`), picture, values,
    element("p", { className: "small quiet why" }, ""),
  );
}

function drawViews(canvas, images, side) {
  if (canvas.width !== side * images.length) [canvas.width, canvas.height] = [side * images.length, side];
  const context = canvas.getContext("2d");
  const picture = context.createImageData(side, side);
  images.forEach((image, at) => {
    for (let i = 0; i < side * side; i += 1) {
      const grey = image ? Math.round(255 * (image[i] / 255) ** 0.6) : 24; // brightened for the eye
      picture.data.set([grey, grey, grey, 255], 4 * i);
    }
    context.putImageData(picture, at * side, 0);
  });
}

function drawValues(panel, values, action, arena) {
  const actions = arena.actions;
  const cells = panel.querySelector(".q").children;
  const why = panel.querySelector(".why");
  if (!values) {
    for (let i = 0; i < actions.length; i += 1) {
      cells[3 * i].className = "";
      cells[3 * i + 1].firstChild.style.width = "0";
      cells[3 * i + 2].textContent = "–";
    }
    why.textContent = "the episode is over";
    return;
  }
  const finite = values.filter((value) => value !== null);
  const low = Math.min(...finite);
  const span = Math.max(...finite) - low || 1;
  const best = values.indexOf(Math.max(...finite));
  values.forEach((value, i) => {
    cells[3 * i].className = i === action ? "chosen" : "";
    cells[3 * i].textContent = `${i === action ? "▶ " : ""}${actions[i]}`;
    cells[3 * i + 1].firstChild.style.width = value === null ? "0" : `${8 + (92 * (value - low)) / span}%`;
    cells[3 * i + 2].textContent = number(value);
  });
  why.textContent = `${isWorld(arena) ? "takes" : "goes"} ${actions[action]}${action === best ? ", the best by its values" : ", at random: it explores"}`;
}

function disc(c, x, y, radius) {
  c.beginPath();
  c.arc(x, y, radius, 0, 2 * Math.PI);
  c.fill();
}

function line(c, x0, y0, x1, y1) {
  c.beginPath();
  c.moveTo(x0, y0);
  c.lineTo(x1, y1);
  c.stroke();
}

// The bytes of zlib data in base64.
async function inflated(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
