// The live view: streams and health by asking now and then, one stream's tracks by server-sent events.
// World frame: metres, x to the right, y up, seen from above. Nothing is drawn but when something has changed.
"use strict";

const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F"]; // Okabe and Ito
const TRAIL_S = 5, ASK_MS = 2000, AGAIN_MS = 1000, SILENT_MS = 3000, EDGE = 44, SLOW = 0.3, KNOWN = 0.95, NAMED = 4; // NAMED: pixels per metre from which classes are written
const ID = 0, LABEL = 1, X = 2, Y = 3, LENGTH = 4, WIDTH = 5, YAW = 6, VX = 7, VY = 8, EXISTENCE = 9, SCORE = 10, AGE = 11, MISSED = 12, FACING = 13;

const at = (id) => document.getElementById(id);
const made = (tag, text) => Object.assign(document.createElement(tag), { textContent: text });
const canvas = at("canvas"), pen = canvas.getContext("2d");
const view = { x: 0, y: 0, scale: 6, follow: true }; // centre in metres, pixels per metre
const fingers = new Map(); // pointer id -> [x, y]
let chosen = decodeURIComponent(location.hash.slice(1));
let frame = null, trails = new Map(), names = [], selected = null, source = null, came = 0, dirty = true, moved = 0, fitted = false;

// What the service says

async function ask() {
  let status = null;
  try {
    const answer = await fetch("status", { cache: "no-store" });
    if (answer.ok) status = await answer.json();
  } catch { /* it does not answer: shown below, and asked again */ }
  const silent = source !== null && performance.now() - came > SILENT_MS;
  const state = status === null ? "no answer" : silent && frame !== null ? `${status.state}, stream silent` : status.state;
  at("state").textContent = state;
  at("state").className = `pill ${state === "ready" ? "good" : status === null ? "bad" : ""}`;
  if (status !== null && status.sessions) list(status); // while it starts there are none
  setTimeout(ask, document.hidden ? 5 * ASK_MS : ASK_MS);
}

function list(status) {
  at("instance").textContent = `${status.instance} ${status.version}`;
  at("none").hidden = status.sessions.length > 0;
  at("streams").replaceChildren(...status.sessions.map((one) => {
    const row = document.createElement("tr"), button = made("button", one.stream);
    button.onclick = () => choose(one.stream);
    for (const content of [button, one.state, one.rate_hz.toFixed(1), one.latency_p50_ms.toFixed(1), one.tracks]) row.insertCell().append(content);
    row.setAttribute("aria-selected", one.stream === chosen);
    const silent = one.silent || [];
    if (one.sensors && one.sensors.length > 0) button.title = one.sensors.map((name) => silent.includes(name) ? `${name}: silent` : name).join("\n");
    return row;
  }));
  at("problems-title").hidden = !status.problems || status.problems.length === 0;
  at("problems").replaceChildren(...(status.problems || []).slice(-5).reverse().map((problem) => {
    const often = problem.count > 1 ? ` (${problem.count} times)` : "";
    const item = made("li", ` ${problem.stream} ${inWords(problem)}${often}`);
    if (problem.reported_ns) item.prepend(made("time", ago(Date.now() / 1e3 - problem.reported_ns / 1e9)), " ");
    item.prepend(made("code", problem.code), " ");
    return item;
  }));
  if (!chosen && status.sessions.length > 0) choose(status.sessions[0].stream);
}

function inWords(problem) { // as `optipmb status` has it
  const [, reason, jump] = /(?:(.*), )?([+-][\d.]+) s$/.exec(problem.received || "") || [];
  const seconds = Math.abs(jump).toPrecision(3);
  if (problem.code === "late" && jump) return `a frame came too late: ${seconds} s before the newest one`;
  if (problem.code !== "restarted" || !jump) return problem.message;
  const gap = jump >= 0 ? `${seconds} s gap` : `stamps ${seconds} s earlier`;
  return reason === "publisher" ? `publisher restarted, ${gap}` : `session restarted (${reason}), ${gap}`;
}

function ago(seconds) {
  if (seconds < 1) return "just now";
  const [size, unit] = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]].find(([size]) => seconds >= size);
  return `${Math.floor(seconds / size)} ${unit} ago`;
}

// One stream

function choose(stream) {
  if (source !== null) source.close();
  if (stream !== chosen) history.replaceState(null, "", `#${encodeURIComponent(stream)}`);
  chosen = stream;
  frame = selected = null;
  trails = new Map();
  fitted = false;
  for (const row of at("streams").rows) row.setAttribute("aria-selected", row.cells[0].textContent === stream);
  listen();
}

function listen() {
  came = performance.now();
  source = new EventSource(`live?stream=${encodeURIComponent(chosen)}`);
  const mine = source;
  source.onmessage = (event) => receive(JSON.parse(event.data));
  source.onerror = () => { // also when the service restarts: try until it is back
    mine.close();
    if (mine === source) setTimeout(() => mine === source && listen(), AGAIN_MS);
  };
  dirty = true;
}

function receive(next) {
  came = performance.now();
  if (frame !== null && (next.session !== frame.session || next.time < frame.time)) trails = new Map();
  frame = next;
  for (const track of frame.tracks) {
    const trail = trails.get(track[ID]) || [];
    trail.push([track[X], track[Y], frame.time]);
    trails.set(track[ID], trail);
  }
  for (const [id, trail] of trails) {
    while (trail.length > 0 && frame.time - trail[0][2] > TRAIL_S) trail.shift();
    if (trail.length === 0) trails.delete(id);
  }
  const first = !fitted;
  if (first) fit();
  if (view.follow || (first && fitted)) [view.x, view.y] = middle();
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

const sure = (score) => 0.3 + 0.7 * score; // how strongly a track is drawn

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
  for (const way of [-reach, reach]) line([[x - reach, y - way], [x + reach, y + way]], "#777", 1.2);
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
  if (frame !== null) {
    for (const [x, y] of frame.detections) cross(x, y);
    const shown = new Map(frame.tracks.map((track) => [track[ID], track[SCORE]]));
    for (const [id, trail] of trails) {
      pen.globalAlpha = shown.has(id) ? sure(shown.get(id)) : 0.25; // a track that has ended fades
      line(trail, COLOURS[id % COLOURS.length], 1.5);
    }
    names = [];
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
    pen.fillStyle = "#ffffffd8";
    pen.fillRect(0, 0, EDGE, high);
    pen.fillRect(0, high - 22, wide, 22);
    pen.fillStyle = "#444";
  }
  for (let x = Math.ceil(left / step) * step; x <= right; x += step) {
    const [px] = toScreen(x, 0);
    if (lines) line([[x, top], [x, bottom]], "#e8e8e8", 1);
    else if (px > EDGE + 12 && px < wide - 48) { pen.textAlign = "center"; pen.fillText(+x.toFixed(3), px, high - 7); }
  }
  for (let y = Math.ceil(bottom / step) * step; y <= top; y += step) {
    const [, py] = toScreen(0, y);
    if (lines) line([[left, y], [right, y]], "#e8e8e8", 1);
    else if (py > 24 && py < high - 26) { pen.textAlign = "right"; pen.fillText(+y.toFixed(3), EDGE - 6, py + 4); }
  }
  if (lines) return;
  pen.textAlign = "right";
  pen.fillText("x (m)", wide - 8, high - 7);
  pen.fillText("y (m)", EDGE - 6, 16);
}

function box(track) {
  const [x, y] = [track[X], track[Y]], colour = COLOURS[track[ID] % COLOURS.length], bold = track[ID] === selected;
  const around = corners(x, y, track[LENGTH], track[WIDTH], track[YAW]);
  const front = [(around[0][0] + around[1][0]) / 2, (around[0][1] + around[1][1]) / 2];
  pen.globalAlpha = bold ? 1 : sure(track[SCORE]);
  line([...around, around[0], around[1]], colour, bold ? 3 : 1.6, track[MISSED] > 0 ? [4, 3] : []);
  pen.globalAlpha *= 0.5 * track[EXISTENCE];
  pen.fillStyle = colour;
  pen.fill();
  pen.globalAlpha = bold ? 1 : sure(track[SCORE]);
  line([[x, y], front], colour, 1.6, track[FACING] < KNOWN ? [2, 3] : []); // dotted: it may face the other way
  if (Math.hypot(track[VX], track[VY]) > SLOW) arrow(x, y, x + track[VX], y + track[VY], colour);
  const [px, py] = toScreen(...around.reduce((a, b) => (a[1] > b[1] ? a : b)));
  pen.textAlign = "center";
  pen.font = `${bold ? "bold " : ""}12px system-ui, sans-serif`;
  pen.lineWidth = 3;
  pen.setLineDash([]);
  pen.strokeStyle = "#ffffffd0";
  const name = bold || view.scale > NAMED ? `${track[ID]} ${frame.labels[track[LABEL]]}` : track[ID];
  let above = py - 4;
  const wide = pen.measureText(name).width, taken = ([x, y, w]) => Math.abs(x - px) < (w + wide) / 2 && Math.abs(y - above) < 12;
  while (names.some(taken) && above > py - 60) above -= 13; // above the names that are there
  if (bold || !names.some(taken)) {
    names.push([px, above, wide]);
    pen.strokeText(name, px, above);
    pen.fillStyle = "#222";
    pen.fillText(name, px, above);
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
  line([[1, 0], [-0.7, 0.6], [-0.3, 0], [-0.7, -0.6], [1, 0]].map(([a, b]) => [x + size * (a * c - b * s), y + size * (a * s + b * c)]), "#fff", 2);
  pen.fillStyle = "#222";
  pen.fill();
}

function tell() {
  at("caption").textContent = frame === null ? (chosen ? `${chosen}: waiting for tracks` : "")
    : `${chosen} · ${frame.profile} · ${frame.tracks.length} tracks${frame.unconfirmed ? ` and ${frame.unconfirmed} not confirmed` : ""}, ${frame.detections.length} detections`;
  const track = frame && frame.tracks.find((one) => one[ID] === selected);
  at("details").hidden = !track;
  if (!track) return;
  const rows = {
    "track": track[ID], "class": frame.labels[track[LABEL]],
    "existence": track[EXISTENCE].toFixed(3), "score": track[SCORE].toFixed(2),
    "speed": `${Math.hypot(track[VX], track[VY]).toFixed(1)} m/s`, "x, y": `${track[X].toFixed(1)}, ${track[Y].toFixed(1)} m`,
    "faces": `${(track[YAW] * 180 / Math.PI).toFixed(0)}° at ${(100 * track[FACING]).toFixed(1)} %`,
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
window.onhashchange = () => choose(decodeURIComponent(location.hash.slice(1)));
if (chosen) listen();
ask();
draw();
