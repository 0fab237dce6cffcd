/* The map: the path, things, standstills, places, the robot now and at the time pointed at. */

const NEAR_PX = 14;
const BESIDE = 0.25;  // of the canvas, to each side, for which the exact path is asked, too
const LARGER = 1.5;  // so much larger than asked for it is drawn until it is asked for anew
const SAME_S = 0.001;  // times of a path are rounded
const NEWER_S = 4;  // what is newer is drawn as the look has it, until it is asked for
const UNSEEN_S = 10;  // the robot may have moved since an older pose

/* The number of the last time that is not after `t`; -1 before the first. */
function lastBefore(times, t) {
  let low = 0;
  let high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/* Whether two boxes of text touch. */
const meet = (one, other) => one.x < other.x + other.w + 3 && other.x < one.x + one.w + 3
  && one.y < other.y + other.h && other.y < one.y + one.h;

/* An exact path from a time on, and what came since. */
function continuedBy(known, more, start) {
  const [from, newer] = [lastBefore(known.t, start - SAME_S) + 1, lastBefore(more.t, known.until) + 1];
  const both = (name) => [...known[name].slice(from), ...more[name].slice(newer)];
  const after = (begins, first, by) => begins.filter((each) => each >= first).map((each) => each - by);
  return { ...known, exact: known.exact && more.exact, until: Math.max(known.until, more.until || 0),
    t: both("t"), x: both("x"), y: both("y"),
    begins: [...after(known.begins, from, from), ...after(more.begins, newer, newer + from - known.t.length)] };
}

class RobotMap {
  /* `told` has time(t, isChosen), thing(thing), stretch(event), closer(box, since): the path is to
     be drawn more exactly; `since`: what is known of it reaches so far, else null. */
  constructor(canvas, told) {
    this.canvas = canvas;
    this.told = told;
    this.draw = eachFrame(() => this.drawn());
    this.view = null;
    this.exact = null;  // the path as it was driven in a part of the map
    this.fits = true;
    this.centre = { x: 0, y: 0 };
    this.scale = 40;
    this.path = null;
    this.t = null;
    this.moment = null;
    this.chosen = null;
    pointers(canvas, {
      hover: (x, y, event) => this.hover(x, y, event),
      leave: () => told.time(null, false),
      click: (x, y) => this.click(x, y),
      drag: (dx, dy) => this.pan(dx, dy),
      drop: () => {},
      zoom: (factor, x, y) => this.zoom(factor, x, y),
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(view) {
    this.view = view;
    const path = view.path;
    this.path = path;
    if (path) Object.assign(path, { starts: new Set(path.begins), of: view.of });
    this.things = view.things.filter((each) => path && each.frame === path.frame);
    this.stops = view.events.filter((each) => each.kind === "stop" && each.x !== undefined);
    const driven = path
      ? `${far(view.distance_m || 0)} driven in ${plain(path.frame || "a frame without a name")}` : "no path";
    this.canvas.setAttribute("aria-label", `Map: ${driven}, ${counted(this.stops.length, "stop")}, `
      + `${counted(this.things.length, "thing")}. Arrow keys move it, plus and minus zoom.`);
    this.draw();
  }

  /* What is in sight, and a little more: its corners, and how long a pixel is (m). */
  box() {
    const [wide, high] = [this.canvas.clientWidth * BESIDE, this.canvas.clientHeight * BESIDE];
    const low = this.world(-wide, this.canvas.clientHeight + high);
    const to = this.world(this.canvas.clientWidth + wide, -high);
    return { x0: low.x, y0: low.y, x1: to.x, y1: to.y, pixel: 1 / this.scale };
  }
  /* The path as it was driven, if it is known for all that is in sight; else null. */
  exactly() {
    const { exact: found, path } = this;
    if (!found || !path || found.frame !== path.frame || found.of !== path.of) return null;
    const [low, to] = [this.world(0, this.canvas.clientHeight), this.world(this.canvas.clientWidth, 0)];
    const { box } = found;
    const isIn = box.x0 <= low.x && box.y0 <= low.y && box.x1 >= to.x && box.y1 >= to.y;
    return isIn && box.pixel * this.scale <= LARGER ? found : null;
  }
  enlarge(box, reply, since, of) {
    const found = since !== null && this.exact ? continuedBy(this.exact, reply, this.view.start) : reply;
    this.exact = { ...found, box, of, starts: new Set(found.begins) };
    if (this.t !== null) this.place(this.t);
    this.draw();
  }
  /* Asks for what is drawn too coarsely. */
  getCloser() {
    const { path } = this;
    if (!path || path.t.length < 2) return;
    const found = this.exactly();
    if (!found) this.told.closer(this.box(), null);
    else if (path.t.at(-1) - found.until > NEWER_S) this.told.closer(found.box, found.until);
  }

  /* Where the robot was at a time: between two poses, or at one shortly before; on what is drawn. */
  at(t) {
    const on = this.between(t);
    const shape = on && this.exactly();
    if (!shape) return on;
    const n = lastBefore(shape.t, t);
    if (n < 0 || n + 1 >= shape.t.length || shape.starts.has(n + 1)) return on;
    const share = (t - shape.t[n]) / (shape.t[n + 1] - shape.t[n] || 1);
    return { yaw: on.yaw, x: shape.x[n] + (shape.x[n + 1] - shape.x[n]) * share,
      y: shape.y[n] + (shape.y[n + 1] - shape.y[n]) * share, isExact: true };
  }
  between(t) {
    const { path } = this;
    if (!path) return null;
    const n = lastBefore(path.t, t);
    if (n < 0) return null;
    const here = { x: path.x[n], y: path.y[n], yaw: path.yaw[n] };
    if (n + 1 === path.t.length || path.starts.has(n + 1)) {
      return t - path.t[n] <= UNSEEN_S ? here : null;
    }
    const share = (t - path.t[n]) / (path.t[n + 1] - path.t[n] || 1);
    const turned = path.yaw[n] === null || path.yaw[n + 1] === null ? null
      : path.yaw[n] + (path.yaw[n + 1] - path.yaw[n]) * share;
    return { x: here.x + (path.x[n + 1] - here.x) * share,
      y: here.y + (path.y[n + 1] - here.y) * share, yaw: turned };
  }

  /* Puts the robot where it was at a time; null: where it is now. */
  place(t) {
    this.t = t;
    this.moment = t === null ? null : this.at(t);
    this.draw();
  }
  /* Puts it where an answer has it: between points of a long path it is not known. */
  correct(answer) {
    const { path } = this;
    if (!answer.robot || !path || answer.frame !== path.frame
      || (this.moment && this.moment.isExact)) return;
    this.moment = { x: answer.robot.x, y: answer.robot.y, yaw: answer.robot.yaw_deg };
    this.draw();
  }
  choose(thing) {
    this.chosen = thing;
    this.draw();
  }

  pan(dx, dy) {
    this.fits = false;
    this.centre.x -= dx / this.scale;
    this.centre.y += dy / this.scale;
    this.draw();
  }
  zoom(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    this.fits = false;
    const before = this.world(x, y);
    this.scale = clamp(this.scale * factor, 0.001, 5000);
    const after = this.world(x, y);
    this.centre.x += before.x - after.x;
    this.centre.y += before.y - after.y;
    this.draw();
  }
  fit() {
    this.fits = true;
    this.draw();
  }
  key(event) {
    const by = 40;
    const moves = { ArrowLeft: [by, 0], ArrowRight: [-by, 0], ArrowUp: [0, by], ArrowDown: [0, -by] };
    if (moves[event.key]) this.pan(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(1.3);
    else if (event.key === "-") this.zoom(1 / 1.3);
    else if (event.key === "0") this.fit();
    else return;
    event.preventDefault();
  }

  world(px, py) {
    return { x: this.centre.x + (px - this.canvas.clientWidth / 2) / this.scale,
      y: this.centre.y - (py - this.canvas.clientHeight / 2) / this.scale };
  }
  px(x) { return this.canvas.clientWidth / 2 + (x - this.centre.x) * this.scale; }
  py(y) { return this.canvas.clientHeight / 2 - (y - this.centre.y) * this.scale; }

  near(points, x, y) {
    let best = null;
    let least = NEAR_PX;
    for (const each of points) {
      const away = Math.hypot(this.px(each.x) - x, this.py(each.y) - y);
      if (away < least) { least = away; best = each; }
    }
    return best;
  }
  /* The time at which the path is nearest to a point of the canvas; null if it is not near. */
  timeNear(x, y) {
    let best = null;
    let least = NEAR_PX;
    const path = this.exactly() || this.path;
    for (let n = 0; path && n < path.t.length; n++) {
      const last = n + 1 === path.t.length || path.starts.has(n + 1);
      const to = last ? n : n + 1;
      const [ax, ay] = [this.px(path.x[n]), this.py(path.y[n])];
      const [dx, dy] = [this.px(path.x[to]) - ax, this.py(path.y[to]) - ay];
      const square = dx * dx + dy * dy;
      const share = square ? clamp(((x - ax) * dx + (y - ay) * dy) / square, 0, 1) : 0;
      const away = Math.hypot(ax + dx * share - x, ay + dy * share - y);
      if (away <= least) { least = away; best = path.t[n] + (path.t[to] - path.t[n]) * share; }
    }
    return best;
  }

  hover(x, y, event) {
    const thing = this.near(this.things || [], x, y);
    if (thing) {
      tip(thing.hint || `${thing.label}, seen ${counted(thing.times, "time")}, last ${clock(thing.last)}`, event);
      return;
    }
    const stop = this.near(this.stops || [], x, y);
    if (stop) {
      const away = stop.end === undefined ? "" : ` for ${lasting(stop.end - stop.t)}`;
      tip(stop.hint || `stood${away}${stop.in ? ` in ${stop.in}` : ""}, from ${clock(stop.t)}`, event);
      this.told.time(stop.t ?? null, false);
      return;
    }
    const t = this.timeNear(x, y);
    const place = t === null ? this.placeAt(x, y) : null;
    tip(place ? place.name : t === null ? "" : clock(t), event);
    this.told.time(t, false);
  }
  click(x, y) {
    const thing = this.near(this.things || [], x, y);
    if (thing) { this.told.thing(thing); return; }
    const stop = this.near(this.stops || [], x, y);
    if (stop) { this.told.stretch(stop); return; }
    const t = this.timeNear(x, y);
    if (t !== null) this.told.time(t, true);
  }

  /* Shows all that is there, as large as it can be. */
  fitted(width, height) {
    const xs = [];
    const ys = [];
    const add = (x, y) => { xs.push(x); ys.push(y); };
    const { places = [], robot, path } = this.view;
    if (path) path.t.forEach((_, n) => add(path.x[n], path.y[n]));
    for (const each of [...this.things, ...this.stops]) add(each.x, each.y);
    if (robot && path && !xs.length) add(robot.x, robot.y);
    for (const each of places) {
      if (each.circle) {
        const [x, y, r] = each.circle;
        add(x - r, y - r);
        add(x + r, y + r);
      } else each.corners.forEach(([x, y]) => add(x, y));
    }
    if (!xs.length) return;
    const low = { x: xs.reduce((a, b) => Math.min(a, b)), y: ys.reduce((a, b) => Math.min(a, b)) };
    const high = { x: xs.reduce((a, b) => Math.max(a, b)), y: ys.reduce((a, b) => Math.max(a, b)) };
    this.centre = { x: (low.x + high.x) / 2, y: (low.y + high.y) / 2 };
    this.scale = Math.min((width - Math.min(70, width / 8)) / Math.max(high.x - low.x, 1),
      (height - 60) / Math.max(high.y - low.y, 1));
  }

  drawn() {
    const { context: c, width, height } = sharp(this.canvas);
    if (!this.view || !width) return;
    if (this.fits) this.fitted(width, height);
    this.getCloser();
    c.font = "12px system-ui, sans-serif";
    c.lineJoin = "round";
    this.drawGrid(c, width, height);
    this.drawPlaces(c);
    this.drawPath(c);
    this.drawStops(c);
    this.drawNames(c, width, height, this.drawThings(c, width, height));
    const { robot, path } = this.view;
    if (robot && path) this.drawRobot(c, robot, colour("now"), this.moment === null);
    if (this.moment) this.drawRobot(c, this.moment, colour("robot"), true);
    if (!(path && path.t.length) && !this.view.no_path) {
      c.fillStyle = colour("soft");
      c.textAlign = "center";
      c.fillText("No poses in this time.", width / 2, height / 2);
      c.textAlign = "left";
    }
  }
  drawGrid(c, width, height) {
    const by = step(width / this.scale, 6);
    const digits = Math.max(0, -Math.floor(Math.log10(by)));
    const low = this.world(0, height);
    const high = this.world(width, 0);
    c.strokeStyle = colour("grid");
    c.fillStyle = colour("soft");
    c.lineWidth = 1;
    c.beginPath();
    for (let n = Math.ceil(low.x / by); n * by < high.x; n++) {
      const x = Math.round(this.px(n * by)) + 0.5;
      c.moveTo(x, 0);
      c.lineTo(x, height);
      if (x > 24 && x < width - 44) c.fillText(`${(n * by).toFixed(digits)}`, x + 3, height - 5);
    }
    for (let n = Math.ceil(low.y / by); n * by < high.y; n++) {
      const y = Math.round(this.py(n * by)) + 0.5;
      c.moveTo(0, y);
      c.lineTo(width, y);
      if (y > 16 && y < height - 22) c.fillText(`${(n * by).toFixed(digits)}`, 3, y - 4);
    }
    c.stroke();
    c.textAlign = "right";
    c.fillText("m", width - 6, height - 5);
    c.textAlign = "left";
  }
  drawPlaces(c) {
    c.lineWidth = 1;
    for (const each of this.view.places || []) {
      c.beginPath();
      if (each.circle) {
        const [x, y, r] = each.circle;
        c.arc(this.px(x), this.py(y), Math.max(r * this.scale, 2), 0, 2 * Math.PI);
      } else {
        for (const [x, y] of each.corners) c.lineTo(this.px(x), this.py(y));
        c.closePath();
      }
      c.fillStyle = colour("place");
      c.fill();
      c.strokeStyle = colour("place-line");
      c.stroke();
    }
  }
  /* Names of places and things go where they cover nothing; what finds no room shows on pointing. */
  drawNames(c, width, height, things) {
    const { robot, places = [] } = this.view;
    const taken = new Map();
    const mark = (x, y, r) => taken.set(`${Math.round(x)} ${Math.round(y)}`,
      { x: x - r, y: y - r, w: 2 * r, h: 2 * r });
    for (const each of this.stops) mark(this.px(each.x), this.py(each.y), 5);
    for (const each of things) mark(each.px, each.py, 6);
    if (robot && this.path) mark(this.px(robot.x), this.py(robot.y), 12);
    const boxes = [...taken.values()];
    const named = (text, ink, w, spots) => {
      const box = spots.map(([x, y]) => ({ x, y, w, h: 14 }))
        .find((one) => one.x >= 2 && one.x + w < width - 2 && one.y >= 2 && one.y < height - 34
          && !boxes.some((other) => meet(other, one)));
      if (!box) return;
      boxes.push(box);
      c.lineWidth = 3;
      c.strokeStyle = colour(ink === "ink" ? "card" : "place");
      c.strokeText(text, box.x, box.y + 11);
      c.fillStyle = colour(ink);
      c.fillText(text, box.x, box.y + 11);
    };
    const name = (each) => {
      const { px: x, py: y } = each;
      const text = plain(each.label).slice(0, 24);
      const w = c.measureText(text).width;
      named(text, "ink", w, [[x + 9, y - 7], [x - 9 - w, y - 7], [x - w / 2, y - 21], [x - w / 2, y + 7],
        [x + 6, y - 19], [x + 6, y + 5], [x - 6 - w, y - 19], [x - 6 - w, y + 5]]);
    };
    things.filter((each) => this.isChosen(each)).forEach(name);
    c.font = `600 ${c.font}`;
    for (const each of places) {
      const text = plain(each.name).slice(0, 24);
      const w = c.measureText(text).width;
      const [left, top, right, bottom] = this.boundsOf(each);
      const [x, y] = [(left + right) / 2 - w / 2, (top + bottom) / 2 - 7];
      const rows = [top + 5, bottom - 19, y, (top + y) / 2, (bottom + y) / 2 - 7];
      const inside = [x, left + 6, right - w - 6].flatMap((column) => rows.map((row) => [column, row]));
      const beside = [[x, top - 17], [x, bottom + 3], [right + 5, y], [left - w - 5, y]];
      named(text, "place-ink", w, right - left > w + 8 ? inside : beside);
    }
    c.font = c.font.replace("600 ", "");
    things.filter((each) => !this.isChosen(each)).forEach(name);
  }
  /* The box around a place in pixels: left, top, right, bottom. */
  boundsOf(place) {
    const corners = place.circle ? [-1, 1].map((sign) => [place.circle[0] + sign * place.circle[2],
      place.circle[1] + sign * place.circle[2]]) : place.corners;
    const [xs, ys] = [corners.map(([x]) => this.px(x)), corners.map(([, y]) => this.py(y))];
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }
  /* The smallest place around a point of the canvas, by its box. */
  placeAt(x, y) {
    let best = null;
    let least = Infinity;
    for (const each of this.view.places || []) {
      const [left, top, right, bottom] = this.boundsOf(each);
      const large = (right - left) * (bottom - top);
      if (x >= left && x <= right && y >= top && y <= bottom && large < least) { least = large; best = each; }
    }
    return best;
  }
  isChosen(thing) {
    const { chosen } = this;
    return Boolean(chosen && chosen.label === thing.label && chosen.x === thing.x && chosen.y === thing.y);
  }
  drawPath(c) {
    const { path } = this;
    if (!path) return;
    c.strokeStyle = colour("path");
    c.lineWidth = 2;
    c.beginPath();
    const exact = this.exactly();
    if (exact) this.trace(c, exact, 0);
    const newer = exact ? lastBefore(path.t, exact.until + SAME_S) + 1 : 0;
    // It goes on from where the exact one ends: a line from a pose before that would cut corners.
    const [end, last] = exact && exact.t.length ? [exact, exact.t.length - 1] : [path, newer - 1];
    this.trace(c, path, newer, last < 0 ? null : [end.x[last], end.y[last]]);
    c.stroke();
  }
  /* A path from a pose on; the line to that comes from `before`, if it is not where a part begins. */
  trace(c, path, first, before = null) {
    if (before && first < path.t.length) c.moveTo(this.px(before[0]), this.py(before[1]));
    for (let n = first; n < path.t.length; n++) {
      const [x, y] = [this.px(path.x[n]), this.py(path.y[n])];
      if (path.starts.has(n) || (n === first && !before)) c.moveTo(x, y);
      else c.lineTo(x, y);
    }
  }
  drawStops(c) {
    c.fillStyle = colour("stood");
    c.strokeStyle = colour("card");
    c.lineWidth = 1.5;
    for (const each of this.stops) {
      const lasted = (each.end || each.t) - each.t || 0;
      c.beginPath();
      c.arc(this.px(each.x), this.py(each.y), clamp(3 + Math.log10(lasted + 1) * 1.6, 4, 10), 0,
        2 * Math.PI);
      c.fill();
      c.stroke();
    }
  }
  /* Draws the things; returns those that are in sight, and where. */
  drawThings(c, width, height) {
    const shown = this.things.map((each) => ({ ...each, px: this.px(each.x), py: this.py(each.y) }))
      .filter(({ px, py }) => px > -20 && py > -20 && px < width + 20 && py < height + 20);
    for (const each of shown) {
      const { px: x, py: y } = each;
      c.fillStyle = colour("seen");
      c.strokeStyle = colour(this.isChosen(each) ? "ink" : "card");
      c.lineWidth = this.isChosen(each) ? 2.5 : 1.5;
      c.beginPath();
      c.moveTo(x, y - 6);
      c.lineTo(x + 6, y);
      c.lineTo(x, y + 6);
      c.lineTo(x - 6, y);
      c.closePath();
      c.fill();
      c.stroke();
    }
    return shown;
  }
  drawRobot(c, robot, fill, isFilled) {
    c.save();
    c.translate(this.px(robot.x), this.py(robot.y));
    c.beginPath();
    if (robot.yaw === null || robot.yaw === undefined) c.arc(0, 0, 8, 0, 2 * Math.PI);
    else {
      c.rotate(-robot.yaw * Math.PI / 180);
      c.moveTo(14, 0);
      c.lineTo(-9, 9);
      c.lineTo(-5, 0);
      c.lineTo(-9, -9);
      c.closePath();
    }
    c.lineWidth = 2;
    c.fillStyle = isFilled ? fill : colour("card");
    c.strokeStyle = isFilled ? colour("card") : fill;
    c.fill();
    c.stroke();
    c.restore();
  }
}
