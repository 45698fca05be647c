"use strict";

// One message a moment: 4 bytes length, JSON, left JPEG, right JPEG. The next one comes when this one
// has been drawn, so a slow page shows fewer moments and never old ones.

const COLORS = ["#46dc8a", "#5fb4ff", "#ffc14d", "#c79bff", "#ff8e7a", "#6fe3e1", "#f49ac1", "#c8d65b"];
const HISTORY_S = 20;
const SILENCE_MS = 500;
const DRAG_PX = 8;
const SEGMENT = "#ffffff";

const $ = (id) => document.getElementById(id);
const views = { left: $("left"), right: $("right") };
const state = {
  moment: null,       // the last header
  images: {},         // bitmap by view
  arrived: 0,
  chosen: "0",
  added: [],          // names of threads that were not seeded yet
  aim: null,          // {view, u, v}: pointer or keyboard
  drag: null,         // {view, from: [u, v], to: [u, v]}
  snap: null,         // the answer to the last question where a click would land
  asking: false,
  history: new Map(), // thread -> [{t, length, left, right, end, internal}]
  trouble: [],        // candidates of a refused seed
};
let socket = null;

/* The line to the console. */

function connect() {
  const token = new URLSearchParams(location.search).get("token") || "";
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/live?token=${encodeURIComponent(token)}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => {
    if (typeof event.data === "string") take(JSON.parse(event.data));
    else show(event.data);
  };
  socket.onclose = () => { link("lost", "no connection to the console"); setTimeout(connect, 1000); };
}

function send(type, fields = {}) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ type, ...fields }));
}

async function show(buffer) {
  const size = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  let at = 4 + size;
  const bitmaps = await Promise.all(header.images.map((length) => {
    const blob = new Blob([new Uint8Array(buffer, at, length)], { type: "image/jpeg" });
    at += length;
    return createImageBitmap(blob);
  }));
  if (bitmaps.length === 2) {
    for (const old of Object.values(state.images)) old.close();
    state.images = { left: bitmaps[0], right: bitmaps[1] };
    state.arrived = performance.now();
  }
  state.moment = header;
  remember(header);
  draw();
  ask();
  send("shown");
}

/* Answers to what the operator did. */

function take(answer) {
  if (answer.answer === "snap" || answer.answer === "error") state.asking = false;
  if (answer.answer === "snap") { state.snap = { view: answer.asked.view, ...answer }; paint(); }
  else if (answer.answer === "snap-box") {
    if (answer.pixel) seed(answer.asked.view, ...answer.pixel);
    else say("No thread in this box.", "bad");
  } else if (answer.answer === "seed") {
    const { thread, view } = answer.asked;
    state.trouble = answer.accepted ? [] : [{ view, pixels: answer.candidates }];
    if (answer.accepted) state.added = state.added.filter((name) => name !== thread);
    const [outcome, ...doubts] = answer.text.split("; ");
    const more = answer.accepted && doubts.length > 2 ? `; and ${doubts.length - 1} more doubts` : "";
    const words = more ? `${outcome}; ${doubts[0]}${more}` : answer.text;
    say(`Thread ${thread}: ${words}`, answer.accepted ? "good" : "bad");
  } else if (answer.answer === "forget") {
    state.history.delete(answer.asked.thread);
    say(answer.text, answer.accepted ? "good" : "bad");
  } else if (answer.answer === "record") say(answer.text, "good");
  else if (answer.answer === "error") say(answer.text, "bad");
}

let silencer = 0;
function say(text, kind) {
  const place = $("message");
  place.textContent = text;
  place.className = kind;
  clearTimeout(silencer);
  silencer = setTimeout(() => { place.textContent = ""; place.className = ""; state.trouble = []; }, 8000);
}

function seed(view, u, v) {
  state.snap = null;
  say(`Looking for thread ${state.chosen} …`, "busy");
  send("seed", { thread: state.chosen, view, u, v });
}

/* What is shown. */

// A state that was stale stays so for a moment, so that nothing flickers.
const held = { thread: null, until: 0 };
function hold(moment) {
  const now = performance.now();
  const stale = moment.threads.find((thread) => thread.stale);
  if (stale) Object.assign(held, { thread: stale, until: now + 400 });
  return now < held.until ? held.thread : null;
}

function link(kind, text) {
  document.body.dataset.link = kind;
  $("link").textContent = text;
}

function draw() {
  const { moment } = state;
  if (!moment) return;
  $("rig").textContent = moment.rig;
  const silent = performance.now() - state.arrived > SILENCE_MS;
  const stale = hold(moment);
  if (moment.waiting) link("idle", "waiting for a system to run");
  else if (silent) link("stale", "no images");
  else if (stale) link("stale", `stale: ${stale.stale}`);
  else if (!moment.threads.length) link("idle", "live, click on a thread");
  else link("live", "live");
  $("rate").textContent = moment.rate_hz == null ? "–" : `${moment.rate_hz.toFixed(1)} Hz`;
  $("latency").textContent = moment.latency_ms == null ? "–" : `${moment.latency_ms.toFixed(0)} ms`;
  if (moment.frame != null) $("frame").textContent = moment.frame;
  if (moment.warnings && moment.warnings.length) say(moment.warnings.join(" "), "bad");
  const recording = Boolean(moment.recording);
  $("record").setAttribute("aria-pressed", recording);
  $("record").firstChild.textContent = recording ? "Recording" : "Record";
  $("record").title = moment.recording || "";
  list();
  pose();
  paint();
  plot();
}

const known = () => (state.moment ? state.moment.threads : []);
const names = () => [...known().map((thread) => thread.id), ...state.added].filter((n, i, a) => a.indexOf(n) === i);
const color = (name) => COLORS[Math.max(0, names().indexOf(name)) % COLORS.length];

function list() {
  const box = $("threads");
  const all = names().length ? names() : ["0"];
  while (box.children.length > all.length) box.lastChild.remove();
  while (box.children.length < all.length) {
    const button = document.createElement("button");
    button.className = "thread";
    button.setAttribute("role", "option");
    for (const part of ["name", "status", "size", "detail"]) {
      const span = document.createElement("span");
      span.className = part;
      button.append(span);
    }
    button.onclick = () => choose(button.dataset.name);
    box.append(button);
  }
  all.forEach((name, i) => {
    const button = box.children[i];
    const [title, status, size, detail] = button.children;
    const thread = known().find((t) => t.id === name);
    button.dataset.name = name;
    button.style.setProperty("--color", color(name));
    button.setAttribute("aria-selected", name === state.chosen);
    title.textContent = `Thread ${name}`;
    const word = !thread ? "not seeded" : thread.stale ? "stale" : thread.status;
    status.textContent = word;
    status.className = `status ${thread ? word : "new"}`;
    const found = thread && thread.length_mm != null;
    size.textContent = found ? `${thread.length_mm.toFixed(1)} mm` : "";
    const sure = found && thread.sigma_mm != null ? `, ± ${thread.sigma_mm.toFixed(2)} mm` : "";
    detail.textContent = found ? `${(100 * thread.seen).toFixed(0)} % seen${sure}` : "click on it in either image";
  });
  $("reset").disabled = !known().some((t) => t.id === state.chosen);
}

function pose() {
  const { grasp } = state.moment;
  $("grasp").checked = Boolean(grasp);
  if (!grasp) $("pose").textContent = "";
  else if (grasp.reason) $("pose").textContent = `Refused: ${grasp.reason}`;
  else {
    const [x, y, z] = grasp.position_mm.map((value) => value.toFixed(1));
    $("pose").textContent = `x ${x}  y ${y}  z ${z} mm, ± ${grasp.sigma_mm.toFixed(2)} mm`;
  }
}

function paint() {
  for (const [view, canvas] of Object.entries(views)) {
    const { moment } = state;
    const [width, height] = (moment && moment.size) || state.size || [640, 480];
    if (moment && moment.size) state.size = moment.size;
    const scale = Math.max(1, (canvas.clientWidth * devicePixelRatio) / width);
    fit(canvas, Math.round(width * scale), Math.round(height * scale));
    canvas.style.aspectRatio = `${width} / ${height}`;
    const pen = canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (state.images[view]) pen.drawImage(state.images[view], 0, 0, width, height);
    // The centre of the first pixel is (0, 0).
    pen.translate(0.5, 0.5);
    for (const thread of known()) curve(pen, thread, view, 1 / Math.sqrt(scale));
    marker(pen, view);
    hints(pen, view);
    if (state.aim && state.aim.view === view && !state.drag) loupe(pen, view, width, height);
  }
}

function fit(canvas, width, height) {
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
}

function stroke(pen, pixels, style, width, dash = []) {
  if (pixels.length < 2) return;
  pen.beginPath();
  pixels.forEach(([u, v], i) => (i ? pen.lineTo(u, v) : pen.moveTo(u, v)));
  pen.setLineDash(dash);
  pen.lineJoin = pen.lineCap = "round";
  pen.strokeStyle = style;
  pen.lineWidth = width;
  pen.stroke();
  pen.setLineDash([]);
}

function curve(pen, thread, view, fine) {
  const pixels = thread[view];
  if (!pixels.length) return;
  const lost = thread.status === "lost" || thread.stale;
  const tint = lost ? "#9aa4ad" : color(thread.id);
  const wide = (thread.id === state.chosen ? 2.6 : 1.8) * fine;
  let from = 0;
  for (let i = 1; i <= pixels.length; i++) {
    if (i < pixels.length && thread.visible[i] === thread.visible[from]) continue;
    const piece = pixels.slice(from, Math.min(i + 1, pixels.length));
    const hidden = lost || !thread.visible[from];
    stroke(pen, piece, "rgba(0,0,0,.55)", wide + 2 * fine, hidden ? [4, 5] : []);
    stroke(pen, piece, tint, wide, hidden ? [4, 5] : []);
    from = i;
  }
  // The start of the curve is a ring, its end a dot: distances count from them.
  dot(pen, pixels[0], 3.4 * fine, null, tint, 1.6 * fine);
  dot(pen, pixels[pixels.length - 1], 3.4 * fine, tint);
}

function dot(pen, [u, v], radius, fill, line, width = 1.2) {
  pen.beginPath();
  pen.arc(u, v, radius, 0, 2 * Math.PI);
  if (fill) { pen.fillStyle = fill; pen.fill(); }
  if (line) { pen.strokeStyle = line; pen.lineWidth = width; pen.stroke(); }
}

function marker(pen, view) {
  const grasp = state.moment && state.moment.grasp;
  if (!grasp || grasp.reason) return;
  const [at, approach, along] = grasp[view];
  const back = [2 * at[0] - approach[0], 2 * at[1] - approach[1]];
  for (const [style, width] of [["rgba(0,0,0,.6)", 4.5], ["#7cc4ff", 2]]) stroke(pen, [back, at], style, width);
  for (const [style, width] of [["rgba(0,0,0,.6)", 4.5], ["#ffffff", 2]]) stroke(pen, [at, along], style, width);
  dot(pen, at, 6, "rgba(11,13,16,.6)", "#7cc4ff", 2);
}

function hints(pen, view) {
  for (const trouble of state.trouble) {
    if (trouble.view === view) for (const pixel of trouble.pixels) dot(pen, pixel, 6, null, "#ffb84d", 1.6);
  }
  if (state.drag && state.drag.view === view) {
    const [[u, v], [x, y]] = [state.drag.from, state.drag.to];
    pen.setLineDash([5, 4]);
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 1.4;
    pen.strokeRect(u, v, x - u, y - v);
    pen.setLineDash([]);
    return;
  }
  const { snap, aim } = state;
  if (!aim || aim.view !== view || !snap || snap.view !== view) return;
  if (snap.pixel) {
    stroke(pen, snap.segment, "rgba(255,255,255,.55)", 1.2, [2, 3]);
    dot(pen, snap.pixel, 6.5, null, "rgba(0,0,0,.6)", 3.5);
    dot(pen, snap.pixel, 6.5, null, SEGMENT, 1.6);
  }
}

// Four times as large, in the corner away from the pointer: threads are thin.
function loupe(pen, view, width, height) {
  const image = state.images[view];
  if (!image) return;
  const { u, v } = state.aim, side = Math.round(0.3 * height), half = side / 8;
  const x = u > width / 2 ? 8 : width - side - 8, y = height - side - 8;
  pen.save();
  pen.beginPath();
  pen.roundRect(x, y, side, side, 6);
  pen.fillStyle = "#000";
  pen.fill();
  pen.clip();
  pen.imageSmoothingEnabled = false;
  pen.drawImage(image, u + 0.5 - half, v + 0.5 - half, 2 * half, 2 * half, x, y, side, side);
  const place = ([a, b]) => [x + (a - u + half) * 4, y + (b - v + half) * 4];
  if (state.snap && state.snap.view === view && state.snap.pixel) dot(pen, place(state.snap.pixel), 6, null, SEGMENT, 1.6);
  const [cx, cy] = place([u, v]);
  pen.strokeStyle = "rgba(255,255,255,.8)";
  pen.lineWidth = 0.8;
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    pen.beginPath(); pen.moveTo(cx + 4 * dx, cy + 4 * dy); pen.lineTo(cx + 12 * dx, cy + 12 * dy); pen.stroke();
  }
  pen.restore();
  pen.strokeStyle = "rgba(255,255,255,.5)";
  pen.lineWidth = 1;
  pen.beginPath(); pen.roundRect(x, y, side, side, 6); pen.stroke();
}

/* Plots of the chosen thread. */

function remember(header) {
  const t = performance.now() / 1000;
  for (const thread of header.threads) {
    const past = state.history.get(thread.id) || [];
    const last = past[past.length - 1];
    if (!thread.stale && !(last && last.frame === thread.frame)) {
      past.push({ t, frame: thread.frame, length: thread.length_mm, left: thread.image_left,
        right: thread.image_right, end: thread.end, internal: thread.internal, held: thread.status !== "lost" });
    }
    while (past.length && past[0].t < t - HISTORY_S) past.shift();
    state.history.set(thread.id, past);
  }
}

function plot() {
  const past = state.history.get(state.chosen) || [];
  const tint = color(state.chosen);
  lines("plot-length", past, [["length", tint]], 1);
  lines("plot-image", past, [["left", "#5fb4ff"], ["right", "#ffab70"]], 2);
  lines("plot-end", past, [["end", "#c79bff"]], 2);
  lines("plot-internal", past, [["internal", "#6fe3e1"]], 1);
}

function lines(id, past, series, digits) {
  const canvas = $(id), ratio = devicePixelRatio;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  fit(canvas, Math.round(width * ratio), Math.round(height * ratio));
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const values = past.flatMap((p) => series.map(([key]) => p[key]).filter((value) => value != null));
  if (!values.length) return;
  let low = Math.min(...values), high = Math.max(...values);
  const least = Math.max(0.02 * Math.abs(high), 2 * 10 ** -digits);
  if (high - low < least) { const middle = (high + low) / 2; low = middle - least / 2; high = middle + least / 2; }
  const now = performance.now() / 1000, side = 58, top = 10, bottom = height - 10;
  const x = (t) => (width - side) * (1 - (now - t) / HISTORY_S);
  const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
  pen.font = `13px ${getComputedStyle(document.body).fontFamily}`;
  pen.textBaseline = "middle";
  pen.fillStyle = "#93a0ad";
  pen.strokeStyle = "#262d35";
  pen.lineWidth = 1;
  for (const value of [low, high]) {
    pen.fillText(value.toFixed(digits), width - side + 8, y(value));
    pen.beginPath(); pen.moveTo(0, y(value)); pen.lineTo(width - side, y(value)); pen.stroke();
  }
  for (const [key, tint] of series) {
    pen.strokeStyle = tint;
    pen.lineWidth = 1.8;
    pen.lineJoin = "round";
    pen.beginPath();
    let before = null;
    for (const p of past) {
      if (p[key] == null || !p.held) { before = null; continue; }
      if (before === null || p.t - before > 1) pen.moveTo(x(p.t), y(p[key]));
      else pen.lineTo(x(p.t), y(p[key]));
      before = p.t;
    }
    pen.stroke();
  }
}

/* Mouse and keyboard. */

function choose(name) { state.chosen = name; state.trouble = []; draw(); }

function pixel(canvas, event) {
  const box = canvas.getBoundingClientRect();
  const [width, height] = state.size || [640, 480];
  return [((event.clientX - box.left) / box.width) * width - 0.5, ((event.clientY - box.top) / box.height) * height - 0.5];
}

function ask() {
  if (!state.aim || state.asking || state.drag) return;
  state.asking = true;
  send("snap", state.aim);
}

for (const [view, canvas] of Object.entries(views)) {
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    canvas.setPointerCapture(event.pointerId);
    const at = pixel(canvas, event);
    state.press = { view, from: at, x: event.clientX, y: event.clientY };
  });
  canvas.addEventListener("pointermove", (event) => {
    const [u, v] = pixel(canvas, event);
    state.aim = { view, u, v };
    const { press } = state;
    const far = press && Math.hypot(event.clientX - press.x, event.clientY - press.y) > DRAG_PX;
    if (press && (far || state.drag)) state.drag = { view, from: press.from, to: [u, v] };
    else ask();
    paint();
  });
  canvas.addEventListener("pointerup", (event) => {
    const { press, drag } = state;
    state.press = state.drag = null;
    if (!press) return;
    if (drag) { say("Looking into the box …", "busy"); send("snap-box", { view, corners: [drag.from, drag.to] }); }
    else seed(view, ...pixel(canvas, event));
  });
  canvas.addEventListener("pointercancel", () => { state.press = state.drag = null; });
  canvas.addEventListener("pointerleave", () => { if (!state.drag) { state.aim = state.snap = null; paint(); } });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step && event.key !== "Enter") return;
    event.preventDefault();
    const [width, height] = state.size || [640, 480];
    const aim = state.aim && state.aim.view === view ? state.aim : { view, u: width / 2, v: height / 2 };
    if (!step) { if (state.aim) seed(view, aim.u, aim.v); return; }
    const pace = event.shiftKey ? 1 : 8;
    const inside = (value, most) => Math.min(Math.max(value, 0), most - 1);
    state.aim = { view, u: inside(aim.u + pace * step[0], width), v: inside(aim.v + pace * step[1], height) };
    ask();
    paint();
  });
}

function regrasp(on = true) { send("grasp", { thread: state.chosen, fraction: on ? Number($("fraction").value) : null }); }

function add() {
  let number = 0;
  while (names().includes(String(number))) number += 1;
  if (!names().length) { choose("0"); return; }
  state.added.push(String(number));
  choose(String(number));
  say(`Click on thread ${number} in either image.`, "busy");
}

function reset() { if (!$("reset").disabled) send("forget", { thread: state.chosen }); }

function record() {
  const on = !(state.moment && state.moment.recording);
  say(on ? "Starting to record …" : "Completing the recording …", "busy");
  send("record", { on });
}

$("record").onclick = record;
$("new").onclick = add;
$("reset").onclick = reset;
$("grasp").onchange = (event) => regrasp(event.target.checked);
$("fraction").oninput = () => regrasp();

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  if (key >= "1" && key <= "9") { const name = names()[Number(key) - 1]; if (name) choose(name); }
  else if (key === "n") add();
  else if (key === "r") reset();
  else if (key === "s") record();
  else if (key === "g") regrasp(!$("grasp").checked);
  else if (key === "[" || key === "]") {
    $("fraction").value = Number($("fraction").value) + (key === "[" ? -0.01 : 0.01);
    regrasp();
  } else if (key === "f") {
    if (document.fullscreenElement) document.exitFullscreen(); else document.documentElement.requestFullscreen();
  } else if (key === "escape") { state.press = state.drag = state.snap = null; state.trouble = []; paint(); }
});

setInterval(draw, 250);
connect();
