"use strict";
/* Text, numbers and times of the page. Everything that was recorded goes through `el`. */

const AT_ONCE = 6;
const at = (id) => document.getElementById(id);

/* Invisible and direction-changing characters are spelled out: a name must not pass for another. */
const HIDDEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]/g;
function plain(text) {
  return String(text).replace(HIDDEN,
    (one) => "\\u" + one.charCodeAt(0).toString(16).padStart(4, "0"));
}

/* Makes an element whose children are elements or text nodes, never markup. */
function el(name, given = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(given)) {
    if (typeof value === "function") made.addEventListener(key, value);
    else made.setAttribute(key, value);
  }
  for (const child of children) {
    made.append(child instanceof Node ? child : document.createTextNode(plain(child)));
  }
  return made;
}
const soft = (...texts) => el("p", { class: "soft" }, ...texts);
const bdi = (text) => el("bdi", {}, text);
const entry = (term, ...value) => el("div", {}, el("dt", {}, term), el("dd", {}, ...value));
const pair = (left, right) => el("li", { class: "pair" }, left, el("span", {}, right));
const link = (text, click) => el("button", { type: "button", class: "plain", click }, bdi(text));

/* Of a long list the first rows, and the others on demand. */
function listing(rows, most = AT_ONCE) {
  if (!rows.length) return [];
  if (rows.length <= most + 1) return [el("ul", {}, ...rows)];
  const rest = rows.slice(most);
  return [el("ul", {}, ...rows.slice(0, most)), el("details", {},
    el("summary", {}, `${rest.length} more`), el("ul", {}, ...rest))];
}

/* What can be unfolded in an element, by its title without a number before it. */
function foldsOf(host) {
  const [folds, times] = [new Map(), new Map()];
  for (const each of host.querySelectorAll("details")) {
    const name = each.firstChild.textContent.replace(/^\d+ /, "");
    times.set(name, (times.get(name) || 0) + 1);
    folds.set(`${name} ${times.get(name)}`, each);
  }
  return folds;
}
/* Replaces what an element has; what somebody has unfolded stays so. */
function refill(host, ...children) {
  const before = foldsOf(host);
  host.replaceChildren(...children);
  for (const [name, each] of foldsOf(host)) each.open ||= Boolean(before.get(name)?.open);
}

function lasting(seconds) {
  const s = Math.abs(seconds);
  if (s < 9.95) return s.toFixed(1) + " s";
  if (s < 119.5) return Math.round(s) + " s";
  if (s < 7170) return Math.round(s / 60) + " min";
  if (s < 171000) return (s / 3600).toFixed(1) + " h";
  if (s < 60 * 86400) return (s / 86400).toFixed(1) + " d";
  if (s < 730 * 86400) return Math.round(s / 86400) + " d";
  return (s / 31557600).toFixed(1) + " years";
}
const ago = (seconds) => (seconds < 0.5 ? "now" : `${lasting(seconds)} ago`);
/* How long ago a time is, which `countAgo` keeps right: everywhere from the same moment. */
function agoOf(unix, now) {
  const made = el("span", { class: "ago" }, ago(now - unix));
  made.since = unix;
  return made;
}
function countAgo(now) {
  for (const each of document.querySelectorAll(".ago")) each.textContent = ago(now - each.since);
}
const counted = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;
const DAY = new Intl.DateTimeFormat(undefined, { weekday: "short", day: "numeric", month: "short" });
const DATE = new Intl.DateTimeFormat(undefined,
  { weekday: "short", day: "numeric", month: "short", year: "numeric" });
const CLOCK = new Intl.DateTimeFormat(undefined,
  { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" });
const MINUTE = new Intl.DateTimeFormat(undefined,
  { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const MONTH = new Intl.DateTimeFormat(undefined, { month: "short", year: "numeric" });
const isTime = (unix) => Math.abs(unix) <= 8.64e12;  // of later ones there is no date
const yearOf = (unix) => new Date(unix * 1000).getFullYear();
let hasYears = false;  // whether what is recorded is of several years
const day = (unix) => (hasYears ? DATE : DAY).format(unix * 1000);
const timeOfDay = (unix) => CLOCK.format(unix * 1000);
const clock = (unix) => `${day(unix)}, ${timeOfDay(unix)}`;
/* With the year, unless all is of this one. */
const date = (unix) => (yearOf(unix) === new Date().getFullYear() ? day(unix) : DATE.format(unix * 1000));
const dated = (unix) => `${date(unix)}, ${timeOfDay(unix)}`;
function size(gb) {
  const [times, unit] = gb >= 1 ? [1, "GB"] : gb >= 0.001 ? [1e3, "MB"] : [1e6, "kB"];
  return `${Number((gb * times).toPrecision(3))} ${unit}`;
}
const far = (m) => (m < 10000 ? `${m.toFixed(1)} m` : `${(m / 1000).toFixed(1)} km`);
const centimetres = (metres) => (Math.round(metres * 100) / 100 || 0).toFixed(2);  // never -0.00
const metres = (place) => `x\u00a0${centimetres(place.x)}, y\u00a0${centimetres(place.y)}\u00a0m`;

/* A round step of which some `about` fit into a length. */
function step(length, about = 5) {
  const rough = length / about;
  const power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough);
}
const clamp = (value, low, high) => Math.min(Math.max(value, low), Math.max(low, high));
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/* Makes a canvas as sharp as the screen; returns its context, width and height in CSS pixels. */
function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/* As much of a text as fits into a width. */
function fitting(c, text, wide) {
  if (c.measureText(text).width <= wide) return text;
  let some = text.slice(0, 40);
  while (some && c.measureText(`${some}\u2026`).width > wide) some = some.slice(0, -1);
  return `${some}\u2026`;
}
/* Draws at most once for each frame. */
function eachFrame(draw) {
  let waiting = 0;
  return () => {
    if (!waiting) waiting = requestAnimationFrame(() => { waiting = 0; draw(); });
  };
}

/* Shows a text beside the pointer. */
function tip(text, event) {
  const shown = at("tip");
  shown.hidden = !text;
  if (!text) return;
  shown.textContent = plain(text);
  const { offsetWidth: wide, offsetHeight: high } = shown;
  shown.style.left = `${clamp(event.clientX + 14, 4, window.innerWidth - wide - 4)}px`;
  shown.style.top = `${clamp(event.clientY + 16, 4, window.innerHeight - high - 4)}px`;
}

/* Follows pointers on a canvas: hovering, pressing, dragging and pinching. `told` has
   hover(x, y, event), click(x, y, event), drag(dx, dy, event, from), drop(event),
   zoom(factor, x, y), leave(). */
function pointers(canvas, told) {
  const down = new Map();
  let moved = false;
  let apart = 0;
  const where = (event) => {
    const box = canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    down.set(event.pointerId, where(event));
    canvas.setPointerCapture(event.pointerId);
    if (down.size === 1) moved = false;
    apart = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const here = where(event);
    const before = down.get(event.pointerId);
    if (!before) { told.hover(here.x, here.y, event); return; }
    if (down.size === 2) {
      down.set(event.pointerId, here);
      const [one, other] = [...down.values()];
      const now = Math.hypot(one.x - other.x, one.y - other.y);
      if (apart) told.zoom(now / apart, (one.x + other.x) / 2, (one.y + other.y) / 2);
      apart = now;
      moved = true;
      return;
    }
    if (!moved && Math.hypot(here.x - before.x, here.y - before.y) < 5) return;
    moved = true;
    tip("");
    told.drag(here.x - before.x, here.y - before.y, event, before);
    down.set(event.pointerId, here);
  });
  const up = (event) => {
    const before = down.get(event.pointerId);
    down.delete(event.pointerId);
    apart = 0;
    if (!before || down.size) return;
    if (moved) told.drop(event);
    else if (event.type === "pointerup") told.click(before.x, before.y, event);
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("pointerleave", (event) => {
    if (!down.size) { tip(""); told.leave(event); }
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const here = where(event);
    if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      told.drag(-event.deltaX, 0, event, here);
      told.drop(event);
    } else told.zoom(1.0015 ** -event.deltaY, here.x, here.y);
  }, { passive: false });
}
