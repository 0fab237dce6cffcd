/* The timeline: what was recorded, standstills, a row for each label in view, events, kept moments. */

const GUTTER = 76;  // left of the plots, too: names of lanes, and numbers of axes
const EDGE = 10;
const OVERVIEW = 14;
const LANE = 22;
const LABEL_LANE = 16;
const BELOW = 38;  // times and dates
const MOST_LABELS = 10;
const SHORTEST_S = 1;
const SPANS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200,
  86400, 172800, 604800, 1209600, 2592000, 7776000, 15552000, 31536000, 63072000, 157680000, 315360000];
const MONTH_S = 2592000;
/* What is drawn over what: a fault is seen among many that are none. */
const WORST_LAST = ["accent", "good", "warn", "gap"];
const COLOURS = { error: "gap", "failed goal": "gap", gap: "gap", "clock step": "warn", "low battery": "warn",
  silence: "warn", drop: "warn", flip: "accent", goal: "good" };

/* The labels that were in view, those seen longest first, each with the times: as they were counted,
   and by the events that came since. */
function labelsOf(view) {
  const { labels, until } = view.seen || { labels: [], until: -Infinity };
  const bars = new Map(labels.map((each) => [each.label, each.bars.map(([t, end, text]) => ({ t, end, text }))]));
  for (const each of view.events) {
    if (each.kind !== "thing" || (each.end ?? each.t) <= until) continue;
    if (!bars.has(each.label)) bars.set(each.label, []);
    bars.get(each.label).push(each);
  }
  const rows = [...bars].map(([label, its]) => ({ label, bars: its.map((each) => (
    { kind: "thing", t: each.t, end: each.end ?? each.t, text: each.text ?? `${label} in view` })) }));
  if (labels.length) return rows;
  const length = ({ bars: its }) => its.reduce((sum, each) => sum + each.end - each.t, 0);
  return rows.sort((one, other) => length(other) - length(one));
}

class Timeline {
  /* `told` has span(start, end, isDone), time(t, isChosen), stretch({t, end, text}), label(label),
     labels(number). */
  constructor(canvas, told) {
    this.canvas = canvas;
    this.told = told;
    this.draw = eachFrame(() => this.drawn());
    this.view = null;
    this.span = null;
    this.t = null;
    this.stretch = null;
    this.lanes = [];
    this.hasAll = false;  // rows of all labels, not only of the first
    pointers(canvas, {
      hover: (x, y, event) => this.hover(x, y, event),
      leave: () => told.time(null, false),
      click: (x, y) => this.click(x, y),
      drag: (dx, _dy, event, from) => this.drag(dx, event, from),
      drop: () => this.drop(),
      zoom: (factor, x) => this.zoom(factor, this.timeAt(x)),
    });
    canvas.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(view, span) {
    this.view = view;
    this.span = span;
    this.lanes = this.sorted(view);
    this.bottom = this.lanes.at(-1).top + LANE;
    this.canvas.style.height = `${this.bottom + BELOW}px`;
    this.describe();
    this.draw();
  }
  /* The lanes from top to bottom, each with its bars or marks. */
  sorted(view) {
    const of = (...kinds) => view.events.filter((each) => kinds.includes(each.kind));
    const labels = labelsOf(view);
    this.told.labels(labels.length);
    const seen = (this.hasAll ? labels : labels.slice(0, MOST_LABELS))
      .map(({ label, bars }) => ({ name: label, kind: "seen", label, bars }));
    const all = [{ name: "recorded", kind: "recorded", bars: of("silence") },
      { name: "stood", kind: "stood", bars: of("stop") }, ...seen,
      { name: "events", kind: "events",
        bars: of("error", "failed goal", "low battery", "goal", "flip", "drop", "clock step",
          ...(view.isReply ? ["gap", "silence"] : [])) },
      { name: "kept", kind: "kept", bars: view.moments.map((each) => ({ kind: "kept", t: each.start,
        end: each.end, text: `kept: ${each.label}` })) }];
    // A reply tells what happened, not when something was recorded.
    const lanes = view.isReply ? all.filter(({ kind, bars }) => bars.length && kind !== "recorded") : all;
    let top = OVERVIEW + 6;
    for (const lane of lanes) {
      lane.top = top;
      lane.high = lane.label === undefined ? LANE : LABEL_LANE;
      top += lane.high;
    }
    return lanes;
  }
  laneAt(y) { return this.lanes.find(({ top, high }) => y >= top && y < top + high); }
  describe() {
    const { span, canvas } = this;
    const t = this.t === null ? span.end : this.t;
    canvas.setAttribute("aria-valuemin", span.start.toFixed(0));
    canvas.setAttribute("aria-valuemax", span.end.toFixed(0));
    canvas.setAttribute("aria-valuenow", t.toFixed(0));
    canvas.setAttribute("aria-valuetext", clock(t));
  }
  mark(t) {
    this.t = t;
    if (this.span) this.describe();
    this.draw();
  }
  choose(stretch) {
    this.stretch = stretch;
    this.draw();
  }

  get wide() { return Math.max(this.canvas.clientWidth - GUTTER - EDGE, 1); }
  x(t) { return GUTTER + (t - this.span.start) / (this.span.end - this.span.start) * this.wide; }
  timeAt(x) {
    return this.span.start + (x - GUTTER) / this.wide * (this.span.end - this.span.start);
  }

  /* Moves to a span inside of what is recorded, and a little beyond. */
  go(start, end, isDone = true) {
    const { earliest, latest } = this.view.range;
    const most = Math.max((latest - earliest) * 1.05, SHORTEST_S * 10);
    const length = clamp(end - start, SHORTEST_S, most);
    const middle = clamp((start + end) / 2, earliest, latest);
    this.span = { start: middle - length / 2, end: middle + length / 2 };
    this.describe();
    this.draw();
    this.told.span(this.span.start, this.span.end, isDone);
  }
  pan(share) {
    const by = (this.span.end - this.span.start) * share;
    this.go(this.span.start + by, this.span.end + by);
  }
  zoom(factor, t = this.t === null ? (this.span.start + this.span.end) / 2 : this.t) {
    const { start, end } = this.span;
    this.go(t - (t - start) / factor, t + (end - t) / factor);
  }
  drag(dx, event, from) {
    if (from.y < OVERVIEW + 4) {
      const { earliest, latest } = this.view.range;
      const by = dx / this.wide * (latest - earliest);
      this.go(this.span.start + by, this.span.end + by, false);
    } else if ((event.shiftKey && event.type !== "wheel") || this.marking !== undefined) {
      if (this.marking === undefined) this.marking = this.timeAt(from.x);
      const [one, other] = [this.marking, this.timeAt(from.x + dx)];
      this.choose({ t: Math.min(one, other), end: Math.max(one, other), text: "chosen stretch" });
    } else {
      const by = -dx / this.wide * (this.span.end - this.span.start);
      this.canvas.classList.add("dragged");
      this.go(this.span.start + by, this.span.end + by, false);
    }
  }
  drop() {
    this.canvas.classList.remove("dragged");
    if (this.marking === undefined) this.told.span(this.span.start, this.span.end, true);
    else this.told.stretch(this.stretch);
    this.marking = undefined;
  }
  key(event) {
    const { start, end } = this.span;
    const t = this.t === null ? end : this.t;
    const by = (end - start) / 100;
    const to = { ArrowLeft: t - by, ArrowDown: t - by, ArrowRight: t + by, ArrowUp: t + by,
      PageUp: t + 10 * by, PageDown: t - 10 * by, Home: start, End: end }[event.key];
    if (to !== undefined) {
      if (to < start || to > end) this.pan((to < start ? -1 : 1) * 0.25);
      this.told.time(to, true);
    } else if (event.key === "+" || event.key === "=") this.zoom(1.5);
    else if (event.key === "-") this.zoom(1 / 1.5);
    else if (event.key === "Escape") this.told.time(null, true);
    else return;
    event.preventDefault();
  }

  /* The bar or mark under a point. */
  found(x, y) {
    const lane = this.laneAt(y);
    if (!lane || x < GUTTER) return null;
    let best = null;
    let least = 6;
    for (const each of lane.bars) {
      const left = this.x(each.t);
      const right = Math.max(this.x(each.end === undefined ? each.t : each.end), left);
      const away = Math.max(left - x, x - right, 0);
      const isShorter = best && away === least && each.end - each.t < best.end - best.t;
      if (away < least || isShorter) { least = away; best = each; }
    }
    return best;
  }
  hover(x, y, event) {
    if (!this.view || y < OVERVIEW) return;
    if (x < GUTTER) {
      tip(this.laneAt(y)?.label ?? "", event);
      return;
    }
    const t = this.timeAt(x);
    const found = this.found(x, y);
    const lasted = found && found.end !== undefined && found.end > found.t
      ? `, ${lasting(found.end - found.t)}` : "";
    tip(found ? `${found.text}${lasted}, ${clock(found.t)}` : clock(t), event);
    this.told.time(t, false);
  }
  click(x, y) {
    if (!this.view) return;
    if (x < GUTTER) {
      const { label } = this.laneAt(y) || {};
      if (label !== undefined) this.told.label(label);
      return;
    }
    if (y < OVERVIEW + 4) {
      const { earliest, latest } = this.view.range;
      const middle = earliest + (x - GUTTER) / this.wide * (latest - earliest);
      const half = (this.span.end - this.span.start) / 2;
      this.go(middle - half, middle + half);
      return;
    }
    const found = this.found(x, y);
    if (found && found.end !== undefined && found.end > found.t) this.told.stretch(found);
    else this.told.time(found ? found.t : this.timeAt(x), true);
  }

  drawn() {
    const { context: c, width, height } = sharp(this.canvas);
    if (!this.view || !this.span || !width) return;
    c.font = "11px system-ui, sans-serif";
    this.drawOverview(c);
    const { bottom } = this;
    this.drawTicks(c, bottom, height);
    c.save();
    c.beginPath();
    c.rect(GUTTER, 0, this.wide, height);
    c.clip();
    for (const lane of this.lanes) {
      if (lane.kind === "recorded") this.drawRecorded(c, lane);
      else this.drawLane(c, lane);
    }
    this.drawChosen(c, bottom);
    c.restore();
    c.fillStyle = colour("soft");
    for (const { name, top, high } of this.lanes) {
      c.fillText(fitting(c, plain(name), GUTTER - 6), 0, top + high / 2 + 4);
    }
  }
  /* The whole memory, and which part of it is shown. */
  drawOverview(c) {
    const { earliest, latest, gaps, thinned = [] } = this.view.range;
    const length = latest - earliest || 1;
    const x = (t) => GUTTER + (t - earliest) / length * this.wide;
    c.fillStyle = colour("soft");
    c.fillText("all", 0, 10);
    c.fillStyle = colour("recorded");
    c.fillRect(GUTTER, 3, this.wide, 6);
    c.fillStyle = colour("card");
    for (const [start, end] of gaps) c.fillRect(x(start), 3, Math.max(x(end) - x(start), 1), 6);
    // Days of which only some messages stayed are paler.
    c.globalAlpha = 0.6;
    for (const [start, end] of thinned) c.fillRect(x(start), 3, Math.max(x(end) - x(start), 1), 6);
    c.globalAlpha = 1;
    const left = clamp(x(this.span.start), GUTTER, GUTTER + this.wide);
    const right = clamp(x(this.span.end), left + 3, GUTTER + this.wide);
    c.strokeStyle = colour("accent");
    c.lineWidth = 2;
    c.strokeRect(Math.min(left, GUTTER + this.wide - 3), 1, Math.max(right - left, 3), 10);
  }
  drawTicks(c, bottom, height) {
    const { start, end } = this.span;
    const by = SPANS.find((each) => (end - start) / each <= this.wide / 90) || SPANS.at(-1);
    const ahead = (t) => -new Date(t * 1000).getTimezoneOffset() * 60;
    const unix = (wall) => wall - ahead(wall - ahead(wall));
    c.strokeStyle = colour("grid");
    c.lineWidth = 1;
    c.beginPath();
    const labels = [];
    for (let wall = Math.ceil((start + ahead(start)) / by) * by; unix(wall) < end; wall += by) {
      const t = unix(wall);
      const x = Math.round(this.x(t)) + 0.5;
      c.moveTo(x, OVERVIEW + 4);
      c.lineTo(x, bottom);
      const isDay = wall % 86400 === 0;
      labels.push([x, by > MONTH_S ? MONTH.format(t * 1000) : isDay ? DAY.format(t * 1000) : by < 60 ? timeOfDay(t) : MINUTE.format(t * 1000)]);
    }
    c.stroke();
    c.fillStyle = colour("soft");
    c.textAlign = "center";
    const room = this.wide + GUTTER;
    for (const [x, text] of labels) {
      if (x > GUTTER + 20 && x < room - 20) c.fillText(text, x, Math.min(bottom + 14, height - 14));
    }
    c.textAlign = "left";
    c.fillText(date(start), GUTTER, Math.min(bottom + 29, height - 2));
    if (day(start) !== day(end)) {
      c.textAlign = "right";
      c.fillText(date(end), room, Math.min(bottom + 29, height - 2));
      c.textAlign = "left";
    }
  }
  drawRecorded(c, { top, bars }) {
    const { earliest, latest, gaps } = this.view.range;
    c.fillStyle = colour("recorded");
    c.fillRect(this.x(earliest), top + 3, Math.max(this.x(latest) - this.x(earliest), 1), LANE - 6);
    for (const [start, end] of gaps) {
      const wide = Math.max(this.x(end) - this.x(start), 1);
      c.fillStyle = colour("card");
      c.fillRect(this.x(start), top + 3, wide, LANE - 6);
      c.fillStyle = colour("gap");
      c.fillRect(this.x(start), top + LANE - 7, wide, 3);
    }
    c.fillStyle = colour("warn");
    for (const each of bars) {
      const left = this.x(each.t);
      c.fillRect(left, top + 4, Math.max(this.x(each.end || this.span.end) - left, 2), 4);
    }
  }
  drawLane(c, { kind, bars, top, high }) {
    const middle = top + high / 2;
    c.fillStyle = colour("grid");
    c.fillRect(GUTTER, middle - 0.5, this.wide, 1);
    const isMark = kind === "events";
    const drawn = (each) => isMark ? COLOURS[each.kind] || "accent" : kind;
    const rank = (each) => WORST_LAST.indexOf(drawn(each));
    for (const each of isMark ? [...bars].sort((one, other) => rank(one) - rank(other)) : bars) {
      const left = this.x(each.t);
      const wide = Math.max(this.x(each.end === undefined ? each.t : each.end) - left, 0);
      c.fillStyle = colour(drawn(each));
      if (isMark && wide > 2 && each.kind !== "flip") {
        c.globalAlpha = 0.5;
        c.fillRect(left, middle - 1, wide, 2);
        c.globalAlpha = 1;
      }
      if (isMark) c.fillRect(left - 1.5, top + 3, 3, high - 6);
      else c.fillRect(left, middle - 5, Math.max(wide, 2), 10);
    }
  }
  drawChosen(c, bottom) {
    if (this.stretch) {
      const left = this.x(this.stretch.t);
      c.globalAlpha = 0.18;
      c.fillStyle = colour("accent");
      c.fillRect(left, OVERVIEW + 3, Math.max(this.x(this.stretch.end) - left, 2), bottom - OVERVIEW);
      c.globalAlpha = 1;
    }
    const line = (t, name, wide) => {
      c.strokeStyle = colour(name);
      c.lineWidth = wide;
      c.beginPath();
      c.moveTo(this.x(t), OVERVIEW + 2);
      c.lineTo(this.x(t), bottom + 2);
      c.stroke();
    };
    if (this.view.range.latest !== null) line(this.view.range.latest, "now", 1);
    if (this.t !== null) line(this.t, "robot", 2);
  }
}
