"use strict";
// The page of giantlike view: shows what the server answers, and sends edits.

const TOKEN = document.querySelector("meta[name=token]").content, NS = "http://www.w3.org/2000/svg", $ = id => document.getElementById(id);
const state = { run: null, image: null, index: -1, off: new Set(["detections", "fitted"]), box: null, selected: null, sort: ["index", 1], pairs: null, pairSort: ["", 1], points: null, pointSort: ["sigmas", -1], area: null,
  tab: "fixes", blink: 0, moved: null, other: null, side: false };
const COLUMNS = [["file", "image"], ["target", "target"], ["estimator", "estimator"], ["words", "status"], ["x", "x, px"], ["y", "y, px"], ["sigma_x", "sigma x"],
  ["sigma_y", "sigma y"], ["dx", "o-c x, px"], ["dy", "o-c y, px"], ["range_km", "range, km"], ["sigma_range_km", "sigma range"], ["d_range_percent", "o-c range, %"],
  ["reason", "reason or flags"]];
const PAIRS = [["file", "image"], ["target", "target"], ["estimator", "estimator"], ["minus", "minus"], ["dx", "dx, px"], ["sigma_dx", "sigma"], ["dy", "dy, px"],
  ["sigma_dy", "sigma"], ["d_range_percent", "d range, %"], ["sigma_d_range_percent", "sigma"], ["sigmas", "sigmas"], ["chance", "by chance"]];
const POINTS = [["file", "image"], ["kind", "kind"], ["target", "target"], ["estimator", "estimator"], ["name", "name"], ["x", "x, px"], ["y", "y, px"], ["residual", "residual, px"],
  ["sigma", "sigma, px"], ["sigmas", "residual / sigma"]];
const TEXTS = new Set(["file", "target", "estimator", "words", "reason", "minus", "kind", "name"]);
const SHAPES = { ring: '<circle r="4" fill="none"/>', dot: '<circle r="2" stroke="#0009"/>', cross: '<path d="M-4-4L4 4M4-4L-4 4" fill="none"/>',
  plus: '<path d="M0-4V4M-4 0H4" fill="none"/>' };
const ON_BODIES = /^(landmarks|centers)/;  // marks on bright ground, which get a dark rim
const ENDED = "giantlike view has ended: start it again, and open the address that it prints";
const MOST_ROWS = 2000, MOST_NAMES = 30;

// --- requests, messages and signs of work

const say = text => { $("message").textContent = text; };
const guarded = work => async (...given) => { try { await work(...given); } catch (error) { say(error.message); } };
const works = new Set();
function work(what) {  // shows what is being waited for, until the function that it returns is called
  const one = { what };
  works.add(one);
  setTimeout(showWork, 150);
  return () => { works.delete(one); showWork(); };
}
function showWork() {
  $("busy").textContent = [...works].map(one => one.what).at(-1) ?? "";
  $("busy").classList.toggle("on", works.size > 0);
}
async function request(path, what, options) {
  const done = work(what);
  try {
    let answer;
    try { answer = await fetch(path, options); } catch { throw new Error(ENDED); }
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  } finally { done(); }
}
const get = (path, what = "loading") => request(path, what);
const post = async (path, content) => (await request(path, "writing",
  { method: "POST", headers: { "Content-Type": "application/json", "X-Token": TOKEN }, body: JSON.stringify(content) })).json();

const text = value => {  // ranges keep the digits that their sigmas speak of
  if (typeof value !== "number") return value ?? "";
  const size = Math.abs(value);
  if (size >= 1e12 || (value && size < 1e-3)) return value.toPrecision(3);
  return value.toFixed(size < 10 ? 4 : size < 1e5 ? 3 : size < 1e7 ? 1 : 0);
};
const counted = (number, thing) => `${number} ${thing}${number === 1 ? "" : "s"}`;
const cell = (tag, value, kind = "") => { const made = document.createElement(tag); made.textContent = value; made.className = kind; return made; };
const drawn = (tag, values = {}) => { const made = document.createElementNS(NS, tag); for (const [name, value] of Object.entries(values)) made.setAttribute(name, value); return made; };
const written = (content, x, y, values = {}) => { const made = drawn("text", { x, y, ...values }); made.textContent = content; return made; };

// --- the run and the list of images

async function loadRun() {
  state.run = await (await get("/api/run", "reading the run")).json();
  state.pairs = state.points = null;
  $("name").textContent = state.run.name;
  const verdicts = ["accepted", "suspect", "failed", "rejected"].map(name => [state.run.images.filter(image => image.verdict === name).length, name]).filter(([count]) => count);
  $("count").textContent = `${counted(state.run.images.length, "image")}: ${verdicts.map(each => each.join(" ")).join(", ") || "all ok"}`;
  document.title = `${state.run.name} - giantlike view`;
  $("frames").replaceChildren(...state.run.images.map(image => {
    const button = document.createElement("button"), picture = new Image();
    button.className = image.verdict; button.dataset.index = image.index; button.title = `${image.file}: ${image.verdict}`;
    const review = image.review === "unseen" ? "" : image.review;
    picture.loading = "lazy"; picture.alt = ""; picture.dataset.source = `/thumbnail/${image.index}.jpg`;
    button.append(picture, image.file, cell("span", review && ` (${review})`, "review")); button.onclick = () => choose(image.index);
    watcher.observe(picture);
    return button;
  }));
  for (const [id, values] of [["stretch", state.run.stretches], ["colors", state.run.color_maps]])
    if (!$(id).children.length) $(id).replaceChildren(...values.map(value => new Option(value)));
  $("who").value ||= state.run.who;
  $("other").hidden = $("blink-runs").hidden = !state.run.other;
  filterFilm(); drawRows();
}
const SHOWN = ["all", "ok", "accepted", "suspect", "failed", "rejected", "unseen", "to discuss"];
$("show").replaceChildren(...SHOWN.map(name => new Option(name)));
function filterFilm() {  // by verdict or review, and by name
  const kind = $("show").value, name = $("find").value.trim().toLowerCase();
  const shown = state.run.images.filter(image => (kind === "all" || image.verdict === kind || image.review === kind) && image.file.toLowerCase().includes(name));
  for (const button of $("frames").children) button.hidden = true;
  for (const image of shown) $("frames").children[image.index].hidden = false;
  $("frames").children[state.index]?.scrollIntoView({ block: "nearest" });
}
$("show").onchange = $("find").oninput = filterFilm;
const listed = test => state.run.images.filter(image => !$("frames").children[image.index].hidden && test(image)).map(image => image.index);
function neighbor(sense) {
  const others = listed(() => true).filter(index => sense * (index - state.index) > 0);
  if (others.length) choose(others.at(sense > 0 ? 0 : -1));
}
function nextSuspect() {  // after the last one comes the first
  const suspect = listed(image => image.verdict === "suspect");
  if (suspect.length) choose(suspect.find(index => index > state.index) ?? suspect[0]); else say("no image in the list is suspect");
}
const watcher = new IntersectionObserver(seen => { for (const each of seen) if (each.isIntersecting) { each.target.src = each.target.dataset.source; watcher.unobserve(each.target); } });

let wanted = 0;
const choose = guarded(async index => {
  const number = ++wanted, same = index === state.index;
  const image = await (await get(`/api/image/${index}`, "reading the image")).json();
  if (number !== wanted) return;
  state.image = image; state.index = index; state.other = null; turnTo(false);
  for (const button of $("frames").children) button.classList.toggle("chosen", +button.dataset.index === index);
  if (!same) {
    $("frames").children[index].scrollIntoView({ block: "nearest" });
    $("marks").replaceChildren(); fit(); stopBlink(); select(null);
    $("chart").replaceChildren(); $("readout").textContent = ""; $("picture").style.visibility = "hidden";
  }
  const kinds = [["image", "image"], ...image.targets.flatMap(name => [[`template|${name}`, `template: ${name}`], [`difference|${name}`, `image minus template: ${name}`]])];
  const before = $("kind").value;
  $("kind").replaceChildren(...kinds.map(([value, title]) => new Option(title, value)));
  if (same && kinds.some(kind => kind[0] === before)) $("kind").value = before;
  $("words").textContent = image.words;
  $("reject-image").textContent = decided(edit => edit.what === "image") ? "restore image" : "reject image";
  $("discuss").textContent = decided(edit => edit.what === "review") ? "end discussion" : "discuss";
  const attitude = state.run.images[index].attitude;
  $("accept-attitude").hidden = attitude !== "suspect" && attitude !== "accepted"; $("accept-attitude").textContent = attitude === "accepted" ? "restore attitude" : "accept attitude";
  $("charts").replaceChildren(...image.charts.map(chart => { const button = cell("button", chart.title); button.onclick = () => showChart(chart); return button; }));
  drawPicture(); drawLayers(); move(null); drawArea(null); drawDecisions(); drawRows(); showChosenRow();
  location.hash = image.file;
});

// --- the picture

const address = (kind, side = state.side) => { const [name, target = ""] = kind.split("|");
  return `${side ? `/other/picture/${state.other.index}` : `/picture/${state.index}`}.png?` + new URLSearchParams({ kind: name, target, stretch: $("stretch").value, colors: $("colors").value }); };
let pictureDone = () => {};
function drawPicture(kind = $("kind").value) {
  const picture = $("picture"), image = state.image;
  for (const [name, value] of [["x", -0.5], ["y", -0.5], ["width", image.columns], ["height", image.rows], ["preserveAspectRatio", "none"]]) picture.setAttribute(name, value);
  pictureDone();
  pictureDone = picture.getAttribute("href") === address(kind) ? () => {} : work(kind === "image" ? "reading the picture" : "rendering the template");
  picture.setAttribute("href", address(kind));
}
$("picture").addEventListener("load", () => { pictureDone(); $("picture").style.visibility = ""; });
$("picture").addEventListener("error", guarded(async () => { pictureDone(); await get($("picture").getAttribute("href")); }));
for (const id of ["kind", "stretch", "colors"]) $(id).onchange = () => { stopBlink(); relook(1, 1); drawPicture(); };
function stopBlink() { clearInterval(state.blink); state.blink = 0; for (const id of ["blink", "blink-runs"]) $(id).classList.remove("on"); }

// --- another run, image by image: the part in view stays

const ofSide = () => state.side ? state.other : state.image;
function turnTo(side) { state.side = side; $("other").classList.toggle("on", side); $("name").textContent = side ? state.run.other.name : state.run.name; }
async function readOther() {  // false where the other run has no image of this name
  const { name, images } = state.run.other, index = state.index;
  if (images[state.image.file] === undefined) { say(`${name} has no image ${state.image.file}`); return false; }
  const other = state.other ?? await (await get(`/other/image/${images[state.image.file]}`, "reading the other run")).json();
  if (index !== state.index) return false;
  state.other = other;
  return true;
}
function drawSide(side) { turnTo(side); drawLayers(); $("words").textContent = ofSide().words; }
$("other").onclick = guarded(async () => {
  stopBlink();
  if (state.side || await readOther()) { drawSide(!state.side); drawPicture(); }
});
$("blink-runs").onclick = guarded(async () => {
  if ($("blink-runs").classList.contains("on")) { stopBlink(); drawSide(false); drawPicture(); return; }
  if (!await readOther()) return;
  stopBlink(); $("blink-runs").classList.add("on");
  const index = state.index, pictures = await Promise.all([false, true].map(side => asData(address($("kind").value, side))));
  if (index !== state.index || !$("blink-runs").classList.contains("on")) return;
  state.blink = setInterval(() => { drawSide(!state.side); $("picture").setAttribute("href", pictures[+state.side]); }, 600);
});
$("blink").onclick = () => {
  if ($("blink").classList.contains("on")) { stopBlink(); drawPicture(); return; }
  const target = state.image.targets[0];
  if (!target) { say("there is no body in this image to blink against"); return; }
  $("blink").classList.add("on");
  guarded(async () => {
    const index = state.index, pictures = await Promise.all(["image", `template|${target}`].map(kind => asData(address(kind))));
    if (index !== state.index || !$("blink").classList.contains("on")) return;
    let turn = 0;
    state.blink = setInterval(() => { turn = 1 - turn; $("picture").setAttribute("href", pictures[turn]); }, 600);
  })();
};
async function asData(path) {  // fetched once: a template takes longer to render than it is shown
  const picture = await (await get(path, "rendering the template")).blob();
  return new Promise(done => { const reader = new FileReader(); reader.onload = () => done(reader.result); reader.readAsDataURL(picture); });
}

// --- layers

const isLine = layer => layer.shape === "line" || layer.shape === "dashes";
function drawLayers() {
  $("marks").replaceChildren(...ofSide().layers.map(drawLayer));
  const kinds = [...new Set(ofSide().layers.map(layer => layer.name))];
  const late = state.image.targets.length && !kinds.includes("terminator") ? [lateLayer()] : [];
  $("layers").replaceChildren(...kinds.map(layerSwitch), ...late);
  zoomed();
}
function drawLayer(layer) {
  const group = drawn("g", { stroke: layer.color, fill: layer.color });
  group.dataset.layer = layer.name; group.style.display = state.off.has(layer.name) ? "none" : ""; group.classList.toggle("rejected", layer.rejected);
  if (isLine(layer)) {
    const line = drawn("path", { d: "M" + layer.points.map(point => point.join(" ")).join("L"), class: "line", "stroke-width": 1.2 });
    if (layer.shape === "dashes") line.setAttribute("stroke-dasharray", "6 4");
    const title = drawn("title"); title.textContent = layer.title; line.append(title);
    group.append(line);
    return group;
  }
  layer.points.forEach(([x, y], place) => {
    const mark = drawn("g", { class: layer.star_ids.length ? "mark star" : "mark", "stroke-width": 1.2 });
    mark.style.setProperty("--x", x + "px"); mark.style.setProperty("--y", y + "px");
    const shape = SHAPES[layer.shape] ?? SHAPES.ring;
    mark.innerHTML = (ON_BODIES.test(layer.name) ? shape.replace(" ", ' class="halo" ') : "") + shape;
    const label = layer.labels[place], star = layer.star_ids[place];
    if (label) { const title = drawn("title"); title.textContent = label; mark.append(title); }
    if (layer.names[place]) mark.append(written(layer.names[place], 6, 3));
    if ($("by-residual").checked && layer.sigmas.length) mark.style.stroke = mark.style.fill = colorOf(layer.sigmas[place]);
    if (star !== undefined) { mark.dataset.star = star; mark.onclick = () => state.side ? say("decisions are of the first run: press o") : rejectStar(star); }
    group.append(mark);
  });
  return group;
}
const colorOf = sigmas => `hsl(${120 - 40 * Math.min(sigmas, 3)} 100% 60%)`;  // green, yellow, orange, red at three sigma
$("by-residual").onchange = () => drawLayers();
$("opacity").oninput = () => { $("marks").style.opacity = $("opacity").value; };
function layerSwitch(name) {
  const layers = ofSide().layers.filter(layer => layer.name === name), marked = layers.filter(layer => !isLine(layer));
  const label = document.createElement("label"), box = document.createElement("input"), dot = document.createElement("i");
  box.type = "checkbox"; box.checked = !state.off.has(name); box.dataset.layer = name; dot.style.background = layers[0].color;
  const count = marked.length ? marked.reduce((sum, each) => sum + each.points.length, 0) : layers.length;
  label.append(box, dot, `${name} (${count})`); label.title = layers.map(layer => layer.title).join("\n");
  box.onchange = () => {
    box.checked ? state.off.delete(name) : state.off.add(name);
    for (const group of $("marks").children) if (group.dataset.layer === name) group.style.display = box.checked ? "" : "none";
    nameMarks();
  };
  return label;
}
function lateLayer() {  // the terminator is traced on request
  const button = cell("button", "trace the terminator");
  button.id = "terminator"; button.title = "where the Sun stands at the horizon of the surface";
  button.onclick = guarded(async () => {
    const index = state.index;
    button.disabled = true;
    say("tracing the terminator");
    const layers = await (await get(`/api/terminator/${index}`, "tracing the terminator")).json();
    if (index !== state.index) return;
    say(layers.length ? "" : "no terminator is in view");
    state.image.layers.push(...layers); drawLayers();
  });
  return button;
}

const ruler = document.createElement("canvas").getContext("2d");
ruler.font = "10.5px system-ui, sans-serif";
const widths = new Map();
const widthOf = name => { if (!widths.has(name)) widths.set(name, ruler.measureText(name).width); return widths.get(name); };
function nameMarks() {  // the first in view, which are those that matter most, where they cover no other; zoom in for the others
  const { x, y, w, h } = state.box, scale = scaleOf(), taken = [];
  const free = box => taken.every(each => box[0] > each[2] || box[2] < each[0] || box[1] > each[3] || box[3] < each[1]);
  [...$("marks").children].forEach((group, number) => {
    const layer = ofSide().layers[number], shown = !state.off.has(layer.name);
    if (!layer.names.length) return;
    let left = MOST_NAMES;
    [...group.children].forEach((mark, place) => {
      const [px, py] = layer.points[place], name = layer.names[place];
      let named = shown && Boolean(name) && left > 0 && px > x && px < x + w && py > y && py < y + h;
      if (named) {
        const at = [(px - x) * scale, (py - y) * scale], box = [at[0] - 5, at[1] - 8, at[0] + 10 + widthOf(name), at[1] + 8];  // with its mark
        named = free(box);
        if (named) { taken.push(box); left -= 1; }
      }
      mark.classList.toggle("named", named);
    });
  });
}

// --- the part in view

const scaleOf = () => Math.min($("stage").clientWidth / state.box.w, $("stage").clientHeight / state.box.h);
function fit() { state.box = { x: -0.5, y: -0.5, w: state.image.columns, h: state.image.rows }; zoomed(); }
function zoomed() {
  const { x, y, w, h } = state.box, scale = scaleOf();
  $("view").setAttribute("viewBox", `${x} ${y} ${w} ${h}`);
  $("view").style.setProperty("--k", 1 / scale); $("zoom").textContent = `${scale.toPrecision(3)} x`;
  $("picture").style.imageRendering = scale > 3 ? "pixelated" : "auto";
  nameMarks();
}
function zoom(factor, x, y) {  // about a point of the image; by default the mark that is selected, or the middle
  const box = state.box;
  x ??= state.selected?.point[0] ?? box.x + box.w / 2; y ??= state.selected?.point[1] ?? box.y + box.h / 2;
  state.box = { x: x + (box.x - x) * factor, y: y + (box.y - y) * factor, w: box.w * factor, h: box.h * factor };
  zoomed();
}
function imagePoint(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform($("view").getScreenCTM().inverse());
  return [point.x, point.y];
}
$("view").addEventListener("wheel", event => { event.preventDefault(); zoom(Math.exp(event.deltaY * 0.0015), ...imagePoint(event)); }, { passive: false });
let drag = null, asked = 0;
let look = [1, 1];  // brightness and contrast, by dragging with the right button; the stretch of the menu sets them back
$("view").addEventListener("contextmenu", event => event.preventDefault());
function relook(brightness, contrast) { look = [brightness, contrast]; $("picture").style.filter = look.every(value => value === 1) ? "" : `brightness(${brightness}) contrast(${contrast})`; }
$("view").addEventListener("pointerdown", event => { if (event.button === 2) return; drag = imagePoint(event); if ($("draw").classList.contains("on")) drawArea(null); });
window.addEventListener("pointerup", () => { if (drag && state.area) areaDrawn(); drag = null; });
$("view").addEventListener("pointermove", event => {
  if (!state.image) return;
  const [x, y] = imagePoint(event);
  if (event.buttons & 2) {
    const factor = move => Math.exp(move / 200);
    relook(look[0] * factor(-event.movementY), look[1] * factor(event.movementX));
    return;
  }
  if (drag && $("draw").classList.contains("on")) {
    const points = state.area ?? [[drag[0], drag[1]]], [a, b] = points[0];
    if (event.shiftKey) drawArea([...points, [x, y]]); else drawArea([[a, b], [x, b], [x, y], [a, y]]);
    return;
  }
  if (drag && state.moved) {
    const { at } = state.moved;
    state.moved.at = [at[0] + x - drag[0], at[1] + y - drag[1]]; drag = [x, y];
    drawMoved(); return;
  }
  if (drag) { state.box.x += drag[0] - x; state.box.y += drag[1] - y; zoomed(); return; }
  const place = `x ${x.toFixed(2)}  y ${y.toFixed(2)} px`, number = ++asked;
  $("readout").textContent = place;
  setTimeout(guarded(async () => {
    if (number !== asked || x < -0.5 || y < -0.5 || x > state.image.columns - 0.5 || y > state.image.rows - 0.5) return;
    const seen = await (await get(`/api/pixel/${state.index}?x=${x}&y=${y}`, "tracing the body")).json();
    if (number === asked) $("readout").textContent = place + Object.entries(seen).filter(([name]) => name !== "body")
      .map(([name, value]) => `   ${name === "dn" ? "DN" : name} ${name === "shadowed" ? (value ? "yes" : "no") : +value.toPrecision(7)}${/phase|cidence|emission|tude|^slope|^ra$|^dec$/.test(name) ? " deg" : name === "range" ? " km" : ""}`).join("");
  }), 120);
});
$("view").addEventListener("pointerleave", () => { asked += 1; if (!state.selected && !state.moved) $("readout").textContent = ""; });
$("fit").onclick = fit;
new ResizeObserver(() => state.box && zoomed()).observe($("stage"));

// --- outlines that are dragged to where estimators are to start

function move(one) {  // an outline that is out of view starts in its middle
  const { x, y, w, h } = state.box, inside = one && one.center[0] > x && one.center[0] < x + w && one.center[1] > y && one.center[1] < y + h;
  state.moved = one && { ...one, at: inside ? one.center : [x + w / 2, y + h / 2] };
  $("stage").classList.toggle("moving", Boolean(one));
  const act = (text, does) => { const button = cell("button", text); button.onclick = does; return button; };
  $("starts").replaceChildren(...(one ? [act("solve from here", solveFromHere), act("leave it", () => move(null))]
    : state.image.outlines.map(each => act(`drag ${each.target}`, () => move(each)))));
  drawMoved();
}
function drawMoved() {
  const moved = state.moved;
  $("moved").replaceChildren();
  if (!moved) return;
  const [dx, dy] = [moved.at[0] - moved.center[0], moved.at[1] - moved.center[1]], cross = drawn("g", { class: "mark" });
  cross.style.setProperty("--x", moved.at[0] + "px"); cross.style.setProperty("--y", moved.at[1] + "px");
  cross.append(drawn("path", { d: "M0-9V9M-9 0H9" }));
  const line = moved.outline.map(point => `${point[0] + dx} ${point[1] + dy}`).join("L");
  $("moved").append(...(line ? [drawn("path", { class: "line", d: `M${line}Z` })] : []), cross);
  $("readout").textContent = `${moved.target} at x ${moved.at[0].toFixed(2)}  y ${moved.at[1].toFixed(2)} px`;
}
const solveFromHere = guarded(async () => {
  const { target, at } = state.moved;
  if (await edit("start", { what: "start", file: state.image.file, target, at_px: at })) await solveAgain();
});

// --- areas that are drawn, to mask them or to reject the limb points in them

$("draw").onclick = () => { $("draw").classList.toggle("on"); $("stage").classList.toggle("moving", $("draw").classList.contains("on")); drawArea(null); };
function drawArea(points) {
  state.area = points;
  $("area").setAttribute("d", points ? `M${points.map(point => point.join(" ")).join("L")}Z` : "");
  if (!points) $("drawn").replaceChildren();
}
function inArea([x, y]) {  // by the number of edges to the right
  let inside = false;
  state.area.forEach(([ax, ay], place) => {
    const [bx, by] = state.area.at(place - 1);
    if ((ay > y) !== (by > y) && x < (bx - ax) * (y - ay) / (by - ay) + ax) inside = !inside;
  });
  return inside;
}
function areaDrawn() {
  const step = Math.ceil(state.area.length / 200), area_px = state.area.filter((_, place) => place % step === 0).map(point => point.map(value => +value.toFixed(2)));
  const act = (text, things) => { const button = cell("button", text); button.onclick = guarded(async () => { await edit("mask", { what: "mask", file: state.image.file }, things); }); return button; };
  const limbs = state.image.layers.filter(layer => layer.name === "limb" && !layer.rejected).map(layer => [layer.subject, layer.points.filter(inArea)]).filter(([, points]) => points.length);
  $("drawn").replaceChildren(act("mask it", [{ area_px }]), ...limbs.map(([[target, estimator], points]) =>
    act(`reject ${counted(points.length, "limb point")} of ${estimator}`, points.map(point => ({ target, estimator, area_px: around(point) })))));
  const profile = cell("button", "profile from corner to corner");
  profile.onclick = () => showChart({ which: "profile", line: [...area_px[0], ...area_px[area_px.length >> 1]].join(",") });
  $("drawn").append(profile);
}
const around = ([x, y]) => [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([dx, dy]) => [+(x + dx).toFixed(2), +(y + dy).toFixed(2)]);  // as far as the profile of a limb point needs

// --- marks one by one

function select(mark) {
  state.selected = mark;
  $("selected").replaceChildren();
  if (!mark) return;
  const ring = drawn("g", { class: "mark" });
  ring.style.setProperty("--x", mark.point[0] + "px"); ring.style.setProperty("--y", mark.point[1] + "px");
  ring.append(drawn("circle", { r: 9 }));
  $("selected").append(ring);
  const { x, y, w, h } = state.box;
  if (mark.point[0] < x || mark.point[0] > x + w || mark.point[1] < y || mark.point[1] > y + h) {
    state.box = { x: mark.point[0] - w / 2, y: mark.point[1] - h / 2, w, h }; zoomed();
  }
  asked += 1;  // the readout is of the mark now, not of a pixel whose answer is still due
  $("readout").textContent = `${mark.layer.name} ${mark.place + 1} of ${mark.layer.points.length}: ${mark.layer.labels[mark.place] || mark.layer.title}`
    + `   x ${mark.point[0].toFixed(2)}  y ${mark.point[1].toFixed(2)} px`;
}
function step(sense) {
  const marks = ofSide().layers.filter(layer => !isLine(layer) && !state.off.has(layer.name)).flatMap(layer => layer.points.map((point, place) => ({ layer, place, point })));
  if (!marks.length) { say("the layers shown have no marks"); return; }
  $("stage").focus({ preventScroll: true });  // Enter is for the mark, not for a button that was pressed before
  const now = marks.findIndex(mark => mark.layer === state.selected?.layer && mark.place === state.selected?.place);
  select(marks[now < 0 ? (sense > 0 ? 0 : marks.length - 1) : (now + sense + marks.length) % marks.length]);
}

// --- charts of the image

const showChart = guarded(async chart => {
  const index = state.index, ask = { which: chart.which, target: chart.target ?? "", estimator: chart.estimator ?? "", line: chart.line ?? "", theme: "dark" };
  $("chart").textContent = "drawing";
  try {
    const picture = await (await get(`/chart/${index}.svg?` + new URLSearchParams(ask), "drawing a chart")).text();
    if (index === state.index) $("chart").innerHTML = picture;
  } catch (error) { $("chart").textContent = ""; throw error; }
});

// --- tables

const filterWords = () => $("filter").value.toLowerCase().split(/\s+/).filter(Boolean);
function drawRows() {
  for (const tab of TABS) $(`tab-${tab}`).classList.toggle("on", state.tab === tab);
  const words = filterWords();
  const rows = state.run.fixes.filter(fix => words.every(word => `${fix.file} ${fix.target} ${fix.estimator} ${fix.words} ${fix.reason ?? ""} ${fix.flags.join(" ")}`.toLowerCase().includes(word)));
  $("rows").replaceChildren({ fixes: () => fixTable(rows), compare: compareTable, plots: () => plots(rows), points: pointTable }[state.tab]());
}
function showChosenRow() {  // the table follows the image
  const rows = $("rows"), chosen = [...rows.querySelectorAll("tr.chosen")];
  if (!chosen.length) return;
  const seen = rows.getBoundingClientRect(), head = rows.querySelector("thead").getBoundingClientRect().height;
  const first = chosen[0].getBoundingClientRect().top, last = chosen.at(-1).getBoundingClientRect().bottom;
  if (first < seen.top + head || last > seen.bottom - 16) rows.scrollTop += first - seen.top - head - 26;  // below one row of others
}
function sortable(columns, [by, sense], resort) {
  const table = document.createElement("table"), head = table.createTHead().insertRow();
  for (const [key, title] of columns) {
    const th = cell("th", title + (by === key ? (sense > 0 ? " ▲" : " ▼") : ""), TEXTS.has(key) ? "" : "n");
    th.onclick = () => { resort([key, by === key ? -sense : 1]); drawRows(); };
    head.append(th);
  }
  return [table, head, table.createTBody()];
}
function sorted(rows, [by, sense], value) {
  return by ? [...rows].sort((a, b) => { const [p, q] = [value(a), value(b)]; return sense * (p < q ? -1 : p > q ? 1 : 0); }) : rows;
}
function shownRows(rows, body, columns) {  // so many, with those of the image
  if (rows.length <= MOST_ROWS) return rows;
  const first = Math.max(rows.findIndex(row => row.index === state.index) - MOST_ROWS / 2, 0);
  const note = body.insertRow().insertCell();
  note.colSpan = columns; note.textContent = `rows ${first + 1} to ${Math.min(first + MOST_ROWS, rows.length)} of ${rows.length}: filter for others, or choose another image`;
  return rows.slice(first, first + MOST_ROWS);
}
const why = fix => fix.reason ?? [fix.flags.join(", "), fix.accepted].filter(Boolean).join("; ");
function fixTable(rows) {
  const [table, head, body] = sortable(COLUMNS, state.sort, order => { state.sort = order; }), [by, sense] = state.sort;
  rows = sorted(rows, state.sort, fix => by === "reason" ? why(fix) : fix[by] ?? (sense > 0 ? Infinity : -Infinity));
  head.append(cell("th", "", "do"));
  for (const fix of shownRows(rows, body, COLUMNS.length + 1)) {
    const row = body.insertRow();
    row.className = fix.index === state.index ? "chosen" : ""; row.onclick = () => choose(fix.index);
    for (const [key] of COLUMNS) row.append(key === "words" ? cell("td", fix.words, `t-${fix.outcome}`)
      : key === "reason" ? cell("td", why(fix), "why") : cell("td", text(fix[key]), typeof fix[key] === "number" ? "n" : ""));
    row.querySelector("td.why").title = why(fix);
    const place = row.insertCell();
    place.className = "do";
    if (state.run.images[fix.index].attitude === "rejected") continue;
    for (const action of { ok: ["reject"], suspect: ["accept", "reject"], accepted: ["restore"], rejected: ["restore"] }[fix.outcome] ?? []) {
      const act = cell("button", action);
      act.onclick = guarded(async event => { event.stopPropagation(); await edit(action, { what: "fix", file: fix.file, target: fix.target, estimator: fix.estimator }); });
      place.append(act);
    }
  }
  if (!state.run.fixes.length) body.insertRow().append(cell("td", "no fixes of bodies in this run"));
  return table;
}
function compareTable() {
  const [table, , body] = sortable(PAIRS, state.pairSort, order => { state.pairSort = order; }), [by, sense] = state.pairSort, words = filterWords();
  const rows = (state.pairs ?? []).filter(pair => words.every(word => `${pair.file} ${pair.target} ${pair.estimator} ${pair.minus}`.toLowerCase().includes(word)));
  for (const pair of shownRows(sorted(rows, state.pairSort, pair => pair[by] ?? (sense > 0 ? Infinity : -Infinity)), body, PAIRS.length)) {
    const row = body.insertRow(), doubt = pair.chance < 6.3e-5 ? "t-failed" : pair.chance < 2.7e-3 ? "t-suspect" : "";
    row.className = pair.index === state.index ? "chosen" : ""; row.onclick = () => choose(pair.index);
    for (const [key] of PAIRS) row.append(cell("td", key === "sigmas" ? pair.sigmas.toFixed(1) : key === "chance" ? pair.chance.toPrecision(2) : text(pair[key]),
      typeof pair[key] === "number" ? "n " + (key === "sigmas" || key === "chance" ? doubt : "") : ""));
  }
  if (!state.pairs) guarded(async () => { state.pairs = await (await get("/api/compare", "comparing")).json(); if (state.tab === "compare") { drawRows(); showChosenRow(); } })();
  else if (!rows.length) body.insertRow().append(cell("td", "no two fixes of one body to compare"));
  return table;
}
function pointTable() {
  const columns = [["chosen", ""], ...POINTS], [table, , body] = sortable(columns, state.pointSort, order => { state.pointSort = order; }), [by, sense] = state.pointSort, words = filterWords();
  const points = state.points?.points ?? [], rows = points.filter(point => words.every(word => `${point.file} ${point.kind} ${point.target ?? ""} ${point.estimator ?? ""} ${point.name}`.toLowerCase().includes(word)));
  const count = () => { const chosen = points.filter(point => point.chosen).length; $("reject-points").hidden = !chosen; $("reject-points").textContent = `reject ${counted(chosen, "point")}`; };
  for (const point of shownRows(sorted(rows, state.pointSort, point => point[by] ?? ""), body, columns.length)) {
    const row = body.insertRow(), box = document.createElement("input");
    row.className = point.index === state.index ? "chosen" : "";
    row.onclick = guarded(async () => { await choose(point.index); select({ layer: { name: point.kind, points: [point], labels: [], title: point.name }, place: 0, point: [point.x, point.y] }); });
    box.type = "checkbox"; box.checked = Boolean(point.chosen); box.disabled = point.rejected; box.title = point.rejected ? "rejected already" : "select";
    box.onclick = event => { event.stopPropagation(); point.chosen = box.checked; count(); };
    row.insertCell().append(box);
    for (const [key] of POINTS) row.append(cell("td", text(point[key]), typeof point[key] === "number" ? "n" : ""));
  }
  if (!state.points) guarded(async () => { state.points = await (await get("/api/points", "reading points")).json(); if (state.tab === "points") drawRows(); })();
  else if (state.points.count > points.length) body.insertRow().append(cell("td", `the largest ${points.length} of ${state.points.count}`));
  count();
  return table;
}
$("reject-points").onclick = guarded(async () => {
  const chosen = state.points.points.filter(point => point.chosen), masks = chosen.filter(point => point.kind === "limb"), others = chosen.filter(point => point.kind !== "limb");
  const things = [...masks.map(({ file, target, estimator, x, y }) => ({ action: "mask", what: "mask", file, target, estimator, area_px: around([x, y]) })),
    ...others.map(({ file, kind, target, estimator, name, star }) => ({ what: kind, file, ...(star ? { star } : { target, estimator, landmark: name }) }))];
  await edit("reject", { what: counted(things.length, "point") }, things);
});
const TABS = ["fixes", "compare", "plots", "points"];
for (const tab of TABS) $(`tab-${tab}`).onclick = () => { state.tab = tab; drawRows(); showChosenRow(); };
$("filter").oninput = drawRows;

// --- plots over the campaign

const PLOTTED = [["dx", "sigma_x", "o-c x, px"], ["dy", "sigma_y", "o-c y, px"], ["d_range_percent", "sigma_d_range_percent", "o-c range, %"]];
const PLOT_COLORS = ["#ff5c7a", "#37c8ff", "#8dff6a", "#ff9de2", "#ffffff", "#ffa042"];
const MS = 1, SECOND = 1000 * MS, MINUTE = 60 * SECOND, HOUR = 60 * MINUTE, DAY = 24 * HOUR;
const TIME_STEPS = [...[1, 2, 5, 10, 20, 50, 100, 200, 500].map(step => step * MS), ...[1, 2, 5, 10, 20, 30].map(step => step * SECOND), ...[1, 2, 5, 10, 20, 30].map(step => step * MINUTE),
  ...[1, 2, 3, 6, 12].map(step => step * HOUR), ...[1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000].map(step => step * DAY)];
const timeOf = image => image.epoch ? Date.parse(image.epoch.replace(/:60(\.\d*)?/, ":59.999").replace(/Z?$/, "Z")) : NaN;
function ticksOf(low, high, step) {
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.max(Math.floor(high / step + 1e-9) - first + 1, 0) }, (_, number) => (first + number) * step);
}
function numberTicks(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough)), step = [1, 2, 5, 10].find(each => each * power >= rough) * power;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return ticksOf(low, high, step).map(value => [value, digits > 6 ? value.toPrecision(3) : value.toFixed(digits)]);
}
function abscissa(images) {  // of some images: time where each has one, else the number of the image
  const timed = images.every(index => Number.isFinite(timeOf(state.run.images[index]))), at = index => timed ? timeOf(state.run.images[index]) : index;
  const values = images.map(at), low = Math.min(...values), high = Math.max(...values);
  const margin = 0.03 * (high - low) || (timed ? MINUTE : 0.5), ends = [low - margin, high + margin];
  if (!timed) return { at, ends, ticks: numberTicks(...ends, 6).filter(([value]) => Number.isInteger(value)), label: "number of the image" };
  const step = TIME_STEPS.find(each => (ends[1] - ends[0]) / each <= 5) ?? TIME_STEPS.at(-1), iso = value => new Date(value).toISOString();
  const clock = value => step >= DAY ? iso(value).slice(0, 10) : step >= MINUTE ? iso(value).slice(11, 16) : step >= SECOND ? iso(value).slice(11, 19) : iso(value).slice(17, 23);
  return { at, ends, ticks: ticksOf(...ends, step).map(value => [value, clock(value)]), label: step >= DAY ? "UTC" : `UTC, from ${iso(low).slice(0, 10)}` };
}
function plots(rows) {
  const all = document.createElement("div"), legend = cell("div", "", "legend"), names = [...new Set(rows.map(fix => fix.estimator))];
  all.id = "plots";
  for (const [number, name] of names.entries()) { const word = cell("span", "● "); word.style.color = PLOT_COLORS[number % PLOT_COLORS.length]; word.append(cell("span", name)); word.lastChild.style.color = "var(--ink)"; legend.append(word); }
  legend.append(cell("span", "hollow: suspect; bars: one sigma of the measurement; dashed: the image shown"));
  all.append(legend);
  for (const target of new Set(rows.map(fix => fix.target))) {
    const known = rows.filter(fix => fix.target === target && fix.dx !== null), across = abscissa([...new Set(known.map(fix => fix.index))]);
    for (const [key, sigma, title] of PLOTTED) {
      const fixes = known.filter(fix => fix[key] !== null);
      if (fixes.length) all.append(plot(fixes, key, sigma, `${target}: ${title}`, across, names));
    }
  }
  if (all.children.length === 1) all.append(cell("div", "nothing to plot: no fix, or none with a prediction"));
  return all;
}
function plot(fixes, key, sigma, title, across, names) {
  const w = 460, h = 210, left = 56, right = w - 12, top = 26, bottom = h - 40, svg = drawn("svg", { width: w, height: h });
  const sure = fixes.filter(fix => fix.outcome === "ok" && Number.isFinite(fix[sigma]));
  const values = [0, ...fixes.map(fix => fix[key]), ...sure.flatMap(fix => [fix[key] - fix[sigma], fix[key] + fix[sigma]])];
  let low = Math.min(...values), high = Math.max(...values);
  const margin = 0.06 * (high - low) || 1;
  low -= margin; high += margin;
  const x = value => left + (value - across.ends[0]) / (across.ends[1] - across.ends[0]) * (right - left), y = value => bottom - (value - low) / (high - low) * (bottom - top);
  const inside = value => Math.min(Math.max(y(value), top), bottom);  // bars end at the frame
  svg.append(written(title, left, 16, { class: "title" }), written(across.label, right, h - 6, { class: "soft", "text-anchor": "end" }));
  for (const [value, name] of numberTicks(low, high, 5)) svg.append(drawn("path", { class: "grid", d: `M${left} ${y(value)}H${right}` }), written(name, left - 6, y(value) + 4, { "text-anchor": "end" }));
  for (const [value, name] of across.ticks) svg.append(drawn("path", { class: "grid", d: `M${x(value)} ${top}V${bottom}` }), written(name, x(value), bottom + 15, { "text-anchor": "middle" }));
  svg.append(drawn("path", { class: "zero", d: `M${left} ${y(0)}H${right}` }), drawn("path", { class: "axis", d: `M${left} ${top}V${bottom}H${right}` }));
  const now = state.index >= 0 ? x(across.at(state.index)) : NaN;
  if (now >= left && now <= right) svg.append(drawn("path", { class: "now", d: `M${now} ${top}V${bottom}` }));
  for (const fix of fixes) {  // those of one image side by side
    const at = x(across.at(fix.index)) + 4 * (names.indexOf(fix.estimator) - (names.length - 1) / 2), color = PLOT_COLORS[names.indexOf(fix.estimator) % PLOT_COLORS.length], spread = fix[sigma];
    if (Number.isFinite(spread)) svg.append(drawn("path", { class: "bar", stroke: color, d: `M${at} ${inside(fix[key] - spread)}V${inside(fix[key] + spread)}` }));
    const dot = drawn("circle", { cx: at, cy: y(fix[key]), r: 3.5, stroke: color, fill: fix.outcome === "ok" ? color : "var(--panel)" }), name = drawn("title");
    name.textContent = `${fix.file}, ${fix.estimator}: ${text(fix[key])}${Number.isFinite(spread) ? " ± " + text(spread) : ""}`;
    dot.append(name); dot.dataset.index = fix.index; dot.onclick = () => choose(fix.index); svg.append(dot);
  }
  return svg;
}

// --- edits

async function edit(action, thing, things = [{}]) {
  const why = window.prompt(`Why ${action} ${thing.what} ${thing.star ?? thing.estimator ?? ""} ${thing.file ? `of ${thing.file}` : ""}?`);
  if (!why) return false;
  await post("/api/edit", { action, why, who: $("who").value, ...thing, things });
  select(null);
  await loadRun(); await choose(state.index);
  say(`${thing.what} ${DONE[action]}; solve again brings results and report up to date`);
  return true;
}
const DONE = { reject: "rejected", accept: "accepted", discuss: "to discuss", start: "set", mask: "drawn", restore: "restored" };
const decided = test => state.image.edits.some(test);
const toggle = (action, thing, test) => edit(decided(test) ? "restore" : action, { file: state.image.file, ...thing });
const rejectStar = guarded(async star => toggle("reject", { what: "star", star }, one => one.star === star));
for (const [id, action, what] of [["reject-image", "reject", "image"], ["discuss", "discuss", "review"]])
  $(id).onclick = guarded(async () => toggle(action, { what }, one => one.what === what));
$("accept-attitude").onclick = guarded(async () =>
  edit(state.run.images[state.index].attitude === "accepted" ? "restore" : "accept", { what: "attitude", file: state.image.file }));
function drawDecisions() {
  const edits = state.image.edits;
  $("decisions").replaceChildren(...(edits.length ? [cell("h2", "Decided by hand")] : []), ...edits.map(one => {
    const line = document.createElement("div"), act = cell("button", "restore"), { what, file, star, target, estimator, landmark, area_px } = one;
    act.onclick = guarded(() => edit("restore", { what, file, star, target, estimator, landmark, area_px }));
    line.append(act, ` ${DONE[one.action]}: ${one.name}: ${one.why} (${one.who})`);
    return line;
  }));
}
const solveAgain = guarded(async () => {
  const done = work("solving");
  try {
    let now = await post("/api/solve", {});
    while (now.state === "at work") { say(now.text); await new Promise(next => setTimeout(next, 400)); now = await (await get("/api/solve", "solving")).json(); }
    await loadRun(); await choose(state.index);
    say(now.state === "done" ? `solved: ${now.text}` : now.text);
  } finally { done(); }
});

$("solve").onclick = solveAgain;

// --- panels that can be resized, by pointer and by arrow keys

const PANELS = {  // the width or height that a pointer, or a step, gives to a panel, and the largest part of the window
  film: [event => event.clientX, "ArrowRight", "ArrowLeft", "film", () => 0.4 * innerWidth, 80],
  side: [event => innerWidth - event.clientX, "ArrowLeft", "ArrowRight", "side", () => 0.6 * innerWidth, 160],
  table: [event => innerHeight - event.clientY, "ArrowUp", "ArrowDown", "table", () => 0.7 * innerHeight, 80],
};
const sizeOf = panel => panel === "table" ? $(panel).getBoundingClientRect().height : $(panel).getBoundingClientRect().width;
function resize(panel, size) {
  const [, , , , most, least] = PANELS[panel];
  document.documentElement.style.setProperty(`--${panel}`, `${Math.round(Math.min(Math.max(size, least), most()))}px`);
}
for (const [panel, [size, more, less]] of Object.entries(PANELS)) {
  const split = $(`split-${panel}`);
  split.addEventListener("pointerdown", event => { split.setPointerCapture(event.pointerId); event.preventDefault(); });
  split.addEventListener("pointermove", event => { if (split.hasPointerCapture(event.pointerId)) resize(panel, size(event)); });
  split.addEventListener("keydown", event => { const sense = { [more]: 1, [less]: -1 }[event.key]; if (sense) { event.preventDefault(); resize(panel, sizeOf(panel) + 16 * sense); } });
}

// --- keys

const ARROWS = { ArrowDown: [0, 1], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowLeft: [-1, 0] };
window.addEventListener("keydown", event => {
  if (!state.image || event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input:not([type=checkbox]), select, textarea, summary, [role=separator]")) return;
  const arrow = ARROWS[event.key], box = state.box;
  if (arrow && event.shiftKey) { state.box = { ...box, x: box.x + 0.1 * box.w * arrow[0], y: box.y + 0.1 * box.h * arrow[1] }; zoomed(); }
  else if (arrow) neighbor(arrow[0] + arrow[1]);
  else if (event.key === "s") nextSuspect();
  else if (event.key === "+" || event.key === "=") zoom(1 / 1.25);
  else if (event.key === "-") zoom(1.25);
  else if (event.key === "0") fit();
  else if (event.key === "n" || event.key === "p") step(event.key === "n" ? 1 : -1);
  else if (event.key === "b") $("blink").click();
  else if (event.key === "o" && state.run.other) $("other").click();
  else if (event.key === "r" && state.run.other) $("blink-runs").click();
  else if (event.key === "Enter" && !state.side && state.selected?.layer.star_ids.length && !event.target.closest("button")) rejectStar(state.selected.layer.star_ids[state.selected.place]);
  else return;
  event.preventDefault();
});

guarded(async () => {
  await loadRun();
  const named = state.run.images.find(image => image.file === decodeURIComponent(location.hash.slice(1)));
  await choose(named ? named.index : 0);
  document.body.dataset.ready = "yes";
})();
