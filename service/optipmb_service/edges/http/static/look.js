// The live view: streams and health by asking now and then, one stream's tracks by server-sent events.
// World frame: metres, x to the right, y up, seen from above. Nothing is drawn but when something has changed.
"use strict";

const COLOURS = [ // of Okabe and Ito, as they are, darker and lighter
  "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F",
  "#00487A", "#93400A", "#006B4E", "#8A4F72", "#2F7FB5", "#A06E00", "#5E4914",
  "#5BA7D6", "#EE9157", "#4FC39F", "#E0A9C8", "#93D0F2", "#F2C14D", "#B99A4F"];
const DARK = matchMedia("(prefers-color-scheme: dark)");
const TRAIL_S = 5, ASK_MS = 2000, AGAIN_MS = 1000, SILENT_MS = 2000, ANSWER_MS = 10000, LOST_MS = 15000, EDGE = 44, SLOW = 0.3, KNOWN = 0.95, NAMED = 4; // NAMED: pixels per metre from which classes are written
const ID = 0, LABEL = 1, X = 2, Y = 3, LENGTH = 4, WIDTH = 5, YAW = 6, VX = 7, VY = 8, EXISTENCE = 9, SCORE = 10, AGE = 11, MISSED = 12, FACING = 13, OBJECT = 14;

const ROWS = 1000; // streams in the list: a table of ten thousand takes a browser seconds, each time
const ENDS = 5000; // objects whose last places are kept

const globalId = (track) => ((frame.global || [])[frame.tracks.indexOf(track)] || "").slice(0, 8); // as `optipmb links` writes it
const object = (track) => (track[OBJECT] >= 0 ? track[OBJECT] : track[ID]);
const at = (id) => document.getElementById(id);
const made = (tag, text) => Object.assign(document.createElement(tag), { textContent: text });
const canvas = at("canvas"), pen = canvas.getContext("2d");
const view = { x: 0, y: 0, scale: 6, follow: true }; // centre in metres, pixels per metre
const fingers = new Map(); // pointer id -> [x, y]
let chosen = named();
let asking = 0, token = sessionStorage.getItem("token") || "", ink = {};
let frame = null, trails = new Map(), ends = new Map(), gaps = new Map(), names = [], selected = null, source = null, heard = 0, came = 0, why = "", dirty = true, moved = 0, fitted = false;

function named() { // the stream in the address
  try {
    return decodeURIComponent(location.hash.slice(1));
  } catch { // no name was encoded so: as it is written
    return location.hash.slice(1);
  }
}

// What the service says

async function ask() {
  let status = null, now = 0, refusal = "no answer";
  try {
    const answer = await get("status", { signal: AbortSignal.timeout(ANSWER_MS) });
    now = Date.parse(answer.headers.get("date")) || Date.now(); // the clock of its reports
    if (answer.ok) status = await answer.json();
    else if (answer.status === 401) refusal = "token needed";
    else if (answer.status === 403) refusal = "no right to see the status";
  } catch { /* it does not answer: shown below, and asked again */ }
  const state = status === null ? refusal : frame !== null && isStale() ? `${status.state}, stream silent` : status.state;
  at("state").textContent = state;
  at("state").className = `pill ${state === "ready" ? "good" : status === null ? "bad" : ""}`;
  at("token").hidden = refusal !== "token needed";
  if (status === null) at("none").hidden = refusal !== "no answer";
  if (isStale()) dirty = true; // its age
  if (status !== null && status.sessions) list(status, now); // while it starts there are none
  if (chosen && performance.now() - heard > LOST_MS) listen(); // a connection that is lost may never end
  clearTimeout(asking);
  asking = setTimeout(ask, document.hidden ? 5 * ASK_MS : ASK_MS);
}

function get(path, options = {}) {
  return fetch(path, { cache: "no-store", headers: token ? { authorization: `Bearer ${token}` } : {}, ...options });
}

at("token").onsubmit = (event) => {
  event.preventDefault();
  token = at("secret").value.trim();
  sessionStorage.setItem("token", token);
  if (chosen) listen();
  ask();
};

function list(status, now) {
  at("instance").textContent = `${status.instance} ${status.version}`;
  at("none").hidden = status.sessions.length > 0;
  const rows = new Map([...at("streams").rows].map((row) => [row.cells[0].textContent, row])); // they stay: one may have the focus, or be pressed
  const shown = status.sessions.slice(0, ROWS).map((one) => {
    const row = rows.get(one.stream) || newRow(one.stream), silent = one.silent || [];
    const contents = [one.state, one.rate_hz.toFixed(1), one.latency_p50_ms.toFixed(1), one.tracks, since(one.age_s)];
    contents.forEach((content, i) => { row.cells[i + 1].textContent = content; });
    row.cells[0].firstChild.title = (one.sensors || []).map((name) => silent.includes(name) ? `${name}: silent` : name).join("\n");
    return row;
  });
  at("more").hidden = shown.length === status.sessions.length;
  at("more").textContent = `and ${status.sessions.length - shown.length} more: add #site/node/sensor to the address of this page to see one`;
  if (shown.length !== rows.size || shown.some((row, i) => row !== at("streams").rows[i])) at("streams").replaceChildren(...shown);
  at("problems-title").hidden = !status.problems || status.problems.length === 0;
  at("problems").replaceChildren(...(status.problems || []).slice(-5).reverse().map((problem) => {
    const often = problem.count > 1 ? ` (${problem.count} times)` : "";
    const item = made("li", ` ${problem.stream} ${problem.message}${often}`);
    if (problem.reported_ns) item.prepend(made("time", ago(now / 1e3 - problem.reported_ns / 1e9)), " ");
    item.prepend(made("code", problem.code), " ");
    return item;
  }));
  if (!chosen && status.sessions.length > 0) choose(status.sessions[0].stream);
}

function newRow(stream) {
  const row = document.createElement("tr"), button = made("button", stream);
  button.onclick = () => choose(stream);
  row.insertCell().append(button);
  for (let i = 0; i < 5; i += 1) row.insertCell();
  row.setAttribute("aria-selected", stream === chosen);
  return row;
}

function since(seconds) {
  return seconds === undefined || seconds === null ? "" : seconds * 1e3 < SILENT_MS ? "now" : ago(seconds);
}

function ago(seconds) {
  if (seconds < 1) return "just now";
  const [size, unit] = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]].find(([size]) => seconds >= size);
  return `${Math.floor(seconds / size)} ${unit} ago`;
}

// One stream

function choose(stream) {
  if (stream !== chosen) history.replaceState(null, "", `#${encodeURIComponent(stream)}`);
  chosen = stream;
  why = "";
  frame = selected = null;
  [trails, ends, gaps] = [new Map(), new Map(), new Map()];
  fitted = false;
  for (const row of at("streams").rows) row.setAttribute("aria-selected", row.cells[0].textContent === stream);
  showZones();
  listen();
}

async function listen() { // by fetch, because EventSource sends no token
  if (source !== null) source.abort();
  const mine = source = new AbortController();
  heard = performance.now();
  dirty = true;
  try {
    const answer = await get(`live?stream=${encodeURIComponent(chosen)}`, { signal: mine.signal });
    const refusal = answer.ok ? "" : await answer.text();
    if (mine === source) why = refusal.startsWith("{") ? JSON.parse(refusal).error.message : refusal;
    dirty = true;
    if (answer.ok) {
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      for (let text = ""; ;) {
        const { done, value } = await reader.read();
        if (done) break;
        if (mine === source) heard = performance.now();
        const lines = (text + value).split("\n");
        text = lines.pop();
        for (const line of lines) if (line.startsWith("data: ") && mine === source) receive(JSON.parse(line.slice(6)));
      }
    }
  } catch { /* also when the service restarts: try until it is back */ }
  if (mine === source) setTimeout(() => mine === source && listen(), AGAIN_MS);
}

function isStale() {
  return performance.now() - came > SILENT_MS;
}

// Zones of the stream: counts and newest events

const sum = (counts, name) => Object.values(counts || {}).reduce((all, one) => all + (one[name] || 0), 0);

function showZones() {
  const zones = (frame && frame.zones) || [], counts = (frame && frame.counts && frame.counts.zones) || {};
  at("zones-part").hidden = zones.length === 0;
  at("zones").replaceChildren(...zones.map(({ name, line }) => {
    const row = document.createElement("tr"), one = counts[name];
    const cells = line ? ["", `${sum(one, "to_left")} to the left`, "", `${sum(one, "to_right")} to the right`]
      : ["inside", "entered", "distinct", "left"].map((count) => sum(one, count));
    for (const content of [name, ...cells]) row.insertCell().append(content);
    return row;
  }));
  at("events").replaceChildren(...((frame && frame.events) || []).slice().reverse().map((event) => {
    const how = event.how || event.direction || (event.dwell_s ? `${event.dwell_s} s` : "");
    const item = made("li", ` ${event.zone} ${event.kind} ${how} ${event.class} ${event.id}`);
    if (event.at) item.prepend(made("time", event.at.slice(11, 19)));
    return item;
  }));
}

function receive(next) {
  came = performance.now();
  if (frame !== null && next.session === frame.session && next.time < frame.time) return; // corrected by a late frame; the newest one follows
  if (frame !== null && next.session !== frame.session) [trails, ends, gaps] = [new Map(), new Map(), new Map()];
  frame = next;
  for (const track of frame.tracks) {
    const trail = trails.get(track[ID]) || [];
    trail.push([track[X], track[Y], frame.time]);
    trails.set(track[ID], trail);
    const before = ends.get(object(track)); // where the object was last, and the track that it was
    if (before && before[2] !== track[ID]) gaps.set(track[ID], [before, trail[0]]);
    ends.delete(object(track)); // the latest at the end
    ends.set(object(track), [track[X], track[Y], track[ID]]);
    if (ends.size > ENDS) ends.delete(ends.keys().next().value);
  }
  for (const id of gaps.keys()) if (!trails.has(id)) gaps.delete(id);
  for (const [id, trail] of trails) {
    while (trail.length > 0 && frame.time - trail[0][2] > TRAIL_S) trail.shift();
    if (trail.length === 0) trails.delete(id);
  }
  const first = !fitted;
  if (first) fit();
  if (view.follow || (first && fitted)) [view.x, view.y] = middle();
  showZones();
  dirty = true;
}

function fit() { // a scale that shows what there is, between 20 and 160 metres across
  if (frame.tracks.length === 0) return;
  const [x, y] = middle();
  const far = frame.tracks.map((track) => Math.max(Math.abs(track[X] - x), Math.abs(track[Y] - y))).sort((a, b) => a - b);
  const reach = Math.min(80, Math.max(10, far[Math.floor(0.9 * (far.length - 1))] + 5));
  view.scale = Math.min(canvas.clientWidth, canvas.clientHeight) / (2 * reach);
  fitted = true;
}

function middle() {
  if (frame.sensor !== null) return frame.sensor;
  const n = frame.tracks.length;
  const sum = frame.tracks.reduce(([x, y], track) => [x + track[X] / n, y + track[Y] / n], [0, 0]);
  return n > 0 ? sum : [view.x, view.y];
}

// Drawing

const toScreen = (x, y) => [canvas.clientWidth / 2 + (x - view.x) * view.scale, canvas.clientHeight / 2 - (y - view.y) * view.scale];
const toWorld = (px, py) => [view.x + (px - canvas.clientWidth / 2) / view.scale, view.y - (py - canvas.clientHeight / 2) / view.scale];

const sure = (score) => (0.3 + 0.7 * score) * (isStale() ? 0.35 : 1); // how strongly a track is drawn
const colour = (id) => COLOURS[id % COLOURS.length];

function paint() { // the colours of the page, light or dark
  const style = getComputedStyle(document.documentElement);
  for (const name of ["ink", "faint", "grid", "ground", "veil", "zone"]) ink[name] = style.getPropertyValue(`--${name}`);
  dirty = true;
}
DARK.onchange = paint;
paint();

function line(points, colour, width, dash = []) {
  pen.beginPath();
  points.forEach(([x, y], i) => (i ? pen.lineTo(...toScreen(x, y)) : pen.moveTo(...toScreen(x, y))));
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.setLineDash(dash);
  pen.stroke();
}

function cross(x, y) {
  const reach = 3 / view.scale;
  for (const way of [-reach, reach]) line([[x - reach, y - way], [x + reach, y + way]], ink.faint, 1.2);
}

function corners(x, y, length, width, yaw) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([a, b]) => {
    const u = 0.5 * a * length, v = 0.5 * b * width;
    return [x + c * u - s * v, y + s * u + c * v];
  });
}

function draw() {
  requestAnimationFrame(draw);
  const ratio = window.devicePixelRatio || 1, wide = canvas.clientWidth, high = canvas.clientHeight;
  if (!dirty || wide === 0) return;
  dirty = false;
  const size = [Math.round(wide * ratio), Math.round(high * ratio)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, wide, high);
  grid(wide, high, true);
  names = [];
  if (frame !== null) {
    for (const zone of frame.zones || []) area(zone);
    for (const [x, y] of frame.detections) cross(x, y);
    const shown = new Map(frame.tracks.map((track) => [track[ID], track[SCORE]]));
    for (const [id, trail] of trails) {
      pen.globalAlpha = shown.has(id) ? sure(shown.get(id)) : 0.25; // a track that has ended fades
      line(trail, colour(id), 1.5);
    }
    for (const [id, gap] of gaps) if (shown.has(id)) line(gap, colour(id), 0.6);
    for (const track of frame.tracks) box(track);
    pen.globalAlpha = 1;
    if (frame.sensor !== null) sensor(...frame.sensor);
  }
  grid(wide, high, false);
  tell();
}

function grid(wide, high, lines) { // the lines below everything, the axes above it
  const rough = 90 / view.scale, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const [left, top] = toWorld(0, 0), [right, bottom] = toWorld(wide, high);
  pen.font = "12px system-ui, sans-serif";
  if (!lines) {
    pen.fillStyle = ink.veil;
    pen.fillRect(0, 0, EDGE, high);
    pen.fillRect(0, high - 22, wide, 22);
    pen.fillStyle = ink.faint;
  }
  for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
    const [px] = toScreen(x, 0);
    if (lines) line([[x, top], [x, bottom]], ink.grid, 1);
    else if (px > EDGE + 12 && px < wide - 48) { pen.textAlign = "center"; pen.fillText(+x.toFixed(3), px, high - 7); }
  }
  for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
    const [, py] = toScreen(0, y);
    if (lines) line([[left, y], [right, y]], ink.grid, 1);
    else if (py > 24 && py < high - 26) { pen.textAlign = "right"; pen.fillText(+y.toFixed(3), EDGE - 6, py + 4); }
  }
  if (lines) return;
  pen.textAlign = "right";
  pen.fillText("x (m)", wide - 8, high - 7);
  pen.fillText("y (m)", EDGE - 6, 16);
  pen.fillStyle = ink.ink; // the scale: as long as one step of the grid
  const left0 = EDGE + 14, below = high - 34, long = step * view.scale;
  pen.fillRect(left0, below, long, 2);
  for (const end of [left0, left0 + long - 2]) pen.fillRect(end, below - 4, 2, 8);
  pen.textAlign = "center";
  pen.fillText(`${+step.toPrecision(3)} m`, left0 + long / 2, below - 7);
}

function area({ name, polygon, line: path }) {
  const points = polygon ? [...polygon, polygon[0]] : path;
  line(points, ink.zone, polygon ? 1.5 : 3, polygon ? [6, 4] : []);
  if (polygon) {
    pen.globalAlpha = 0.08;
    pen.fillStyle = ink.zone;
    pen.fill();
    pen.globalAlpha = 1;
  }
  const [px, py] = toScreen(...points.reduce((a, b) => (a[1] > b[1] ? a : b)));
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillStyle = ink.zone;
  pen.fillText(name, px + 4, py - 5);
  const wide = pen.measureText(name).width;
  names.push([px + 4 + wide / 2, py - 5, wide]);
}

function box(track) {
  const [x, y] = [track[X], track[Y]], tint = colour(track[ID]), bold = track[ID] === selected;
  const around = corners(x, y, track[LENGTH], track[WIDTH], track[YAW]);
  const front = [(around[0][0] + around[1][0]) / 2, (around[0][1] + around[1][1]) / 2];
  pen.globalAlpha = bold ? 1 : sure(track[SCORE]);
  line([...around, around[0], around[1]], tint, bold ? 3 : 1.6, track[MISSED] > 0 ? [4, 3] : []);
  pen.globalAlpha *= 0.5 * track[EXISTENCE];
  pen.fillStyle = tint;
  pen.fill();
  pen.globalAlpha = bold ? 1 : sure(track[SCORE]);
  line([[x, y], front], tint, 1.6, track[FACING] < KNOWN ? [2, 3] : []); // dotted: it may face the other way
  if (Math.hypot(track[VX], track[VY]) > SLOW) arrow(x, y, x + track[VX], y + track[VY], tint);
  const edges = around.map((corner) => toScreen(...corner)), across = edges.map(([px]) => px), down = edges.map(([, py]) => py);
  pen.textAlign = "center";
  pen.font = `${bold ? "bold " : ""}12px system-ui, sans-serif`;
  pen.lineWidth = 3;
  pen.setLineDash([]);
  pen.strokeStyle = ink.veil;
  const name = bold || view.scale > NAMED ? `${object(track)} ${frame.labels[track[LABEL]]} ${globalId(track)}`.trim() : object(track);
  const wide = pen.measureText(name).width, [cx, cy] = toScreen(x, y);
  const free = ([px, py]) => !names.some(([x, y, w]) => Math.abs(x - px) < (w + wide) / 2 && Math.abs(y - py) < 12);
  const places = [ // above, below, right, left: all beside its box, or none
    [cx, Math.min(...down) - 4], [cx, Math.max(...down) + 13], [Math.max(...across) + wide / 2 + 4, cy + 4], [Math.min(...across) - wide / 2 - 4, cy + 4]];
  const place = places.find(free) || (bold ? places[0] : null);
  if (place) {
    names.push([...place, wide]);
    pen.strokeText(name, ...place);
    pen.fillStyle = ink.ink;
    pen.fillText(name, ...place);
  }
  pen.globalAlpha = 1;
}

function arrow(x0, y0, x1, y1, colour) {
  line([[x0, y0], [x1, y1]], colour, 1.6);
  const way = Math.atan2(y1 - y0, x1 - x0), size = 7 / view.scale;
  line([[x1 - size * Math.cos(way - 0.5), y1 - size * Math.sin(way - 0.5)], [x1, y1],
    [x1 - size * Math.cos(way + 0.5), y1 - size * Math.sin(way + 0.5)]], colour, 1.6);
}

function sensor(x, y, yaw) {
  const size = 11 / view.scale, c = Math.cos(yaw), s = Math.sin(yaw);
  line([[1, 0], [-0.7, 0.6], [-0.3, 0], [-0.7, -0.6], [1, 0]].map(([a, b]) => [x + size * (a * c - b * s), y + size * (a * s + b * c)]), ink.ground, 2);
  pen.fillStyle = ink.ink;
  pen.fill();
}

function tell() {
  at("caption").textContent = frame === null ? (chosen ? `${chosen}: ${why || "waiting for tracks"}` : "")
    : `${chosen} · ${frame.profile} · ${frame.tracks.length} tracks${frame.unconfirmed ? ` and ${frame.unconfirmed} not confirmed` : ""}, ${frame.detections.length} detections${isStale() ? ` · no frame for ${ago((performance.now() - came) / 1e3).replace(" ago", "")}` : ""}`;
  const track = frame && frame.tracks.find((one) => one[ID] === selected);
  at("details").hidden = !track;
  if (!track) return;
  const rows = {
    "track": track[ID], ...(track[OBJECT] >= 0 ? { "object": track[OBJECT] } : {}), ...(globalId(track) ? { "global id": globalId(track) } : {}), "class": frame.labels[track[LABEL]],
    "existence": track[EXISTENCE].toFixed(3), "score": track[SCORE].toFixed(2),
    "speed": `${Math.hypot(track[VX], track[VY]).toFixed(1)} m/s`, "x, y": `${track[X].toFixed(1)}, ${track[Y].toFixed(1)} m`,
    "faces": `${Math.round(track[YAW] * 180 / Math.PI)}° at ${(100 * track[FACING]).toFixed(1)} %`,
    "age": `${track[AGE].toFixed(1)} s`, "last detected": track[MISSED] > 0 ? `${track[MISSED].toFixed(1)} s ago` : "now",
  };
  const place = frame.geographic && frame.geographic[frame.tracks.indexOf(track)];
  if (place) rows["lat, lon"] = `${place[0].toFixed(7)}, ${place[1].toFixed(7)}, facing ${place[3].toFixed(0)}° from north`;
  at("details").replaceChildren(...Object.entries(rows).flatMap(([name, value]) => [made("dt", name), made("dd", value)]));
}

// Hands: drag to move, wheel or two fingers to zoom, tap a track for its figures

function zoom(factor, px = canvas.clientWidth / 2, py = canvas.clientHeight / 2) {
  const before = toWorld(px, py);
  view.scale = Math.min(200, Math.max(0.5, view.scale * factor));
  const after = toWorld(px, py);
  if (!view.follow) [view.x, view.y] = [view.x + before[0] - after[0], view.y + before[1] - after[1]];
  dirty = true;
}

function setFollow(on) {
  view.follow = on;
  at("follow").setAttribute("aria-pressed", on);
  if (on && frame !== null) { fit(); [view.x, view.y] = middle(); }
  dirty = true;
}

function tap(px, py) {
  const [x, y] = toWorld(px, py), reach = 20 / view.scale;
  const far = (track) => Math.hypot(track[X] - x, track[Y] - y) - 0.5 * track[LENGTH];
  const near = (frame ? frame.tracks : []).filter((track) => far(track) < reach).sort((a, b) => far(a) - far(b));
  selected = near.length ? near[0][ID] : null;
  dirty = true;
}

canvas.onpointerdown = (event) => {
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  moved = fingers.size > 1 ? Infinity : 0;
};
canvas.onpointermove = (event) => {
  const before = fingers.get(event.pointerId), now = [event.offsetX, event.offsetY];
  if (!before) return;
  const other = [...fingers].find(([id]) => id !== event.pointerId);
  moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
  if (other) {
    const far = ([x, y]) => Math.hypot(x - other[1][0], y - other[1][1]) + 1;
    zoom(far(now) / far(before), (now[0] + other[1][0]) / 2, (now[1] + other[1][1]) / 2);
  } else if (moved > 6) {
    if (view.follow) setFollow(false);
    view.x -= (now[0] - before[0]) / view.scale;
    view.y += (now[1] - before[1]) / view.scale;
    dirty = true;
  }
  fingers.set(event.pointerId, now);
};
canvas.onpointerup = canvas.onpointercancel = canvas.onpointerleave = (event) => {
  fingers.delete(event.pointerId);
  if (event.type === "pointerup" && moved <= 6) tap(event.offsetX, event.offsetY);
};
canvas.onwheel = (event) => { event.preventDefault(); zoom(Math.exp(-0.0015 * event.deltaY), event.offsetX, event.offsetY); };
at("follow").onclick = () => setFollow(!view.follow);
[at("closer").onclick, at("farther").onclick] = [() => zoom(1.4), () => zoom(1 / 1.4)];
new ResizeObserver(() => { dirty = true; }).observe(canvas);
window.onhashchange = () => choose(named());
if (chosen) listen();
ask();
draw();
