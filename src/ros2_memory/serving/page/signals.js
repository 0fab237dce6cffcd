/* Numbers of messages as plots below the timeline, drawn by uPlot (vendor/). */

const MOST_PLOTS = 4;
const PLOT_HIGH = 110;
const nameOf = (signal) => `${signal.topic}:${signal.field}`;

class Plots {
  /* `told` has time(t, isChosen) and changed(names). */
  constructor(host, told) {
    this.host = host;
    this.told = told;
    this.names = [];
    this.shown = new Map();  // by name: the answer, its plot and its elements
    this.span = { start: 0, end: 1 };
    new ResizeObserver(() => this.resize()).observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.again());
  }

  use(names) {
    this.names = [...new Set(names)].slice(0, MOST_PLOTS);
    for (const name of this.shown.keys()) if (!this.names.includes(name)) this.remove(name);
  }
  remove(name) {
    const one = this.shown.get(name);
    this.shown.delete(name);
    if (one && one.plot) one.plot.destroy();
    if (one) one.box.remove();
  }

  /* Shows answers of the server; `from`: they only continue those that are shown. */
  show(answers, isMore) {
    for (const answer of answers) {
      const name = nameOf(answer);
      if (!this.names.includes(name)) continue;
      const before = this.shown.get(name);
      const merged = isMore && before ? joined(before.answer, answer, this.span.start) : answer;
      if (before && before.plot && merged.t) {
        before.answer = merged;
        before.plot.setData(columns(merged));
      } else {
        this.remove(name);
        this.make(name, merged);
      }
    }
  }
  move(span) {
    this.span = span;
    for (const { plot } of this.shown.values()) {
      if (plot) plot.setScale("x", { min: span.start, max: span.end });
    }
  }
  mark(t) {
    for (const { plot } of this.shown.values()) {
      if (!plot) continue;
      const left = t === null ? -10 : plot.valToPos(t, "x");
      plot.setCursor({ left, top: t === null ? -10 : PLOT_HIGH / 2 }, false);
    }
  }

  make(name, answer) {
    const drop = el("button", { type: "button", "aria-label": `Remove the plot of ${name}`,
      click: () => { this.use(this.names.filter((each) => each !== name)); this.told.changed(); } },
    "\u00d7");
    const box = el("div", { class: "plot", role: "img", "aria-label": this.words(name, answer) });
    const whole = el("div", {}, el("p", { class: "soft" }, bdi(name), drop), box);
    this.host.append(whole);
    const one = { answer, box: whole, plot: null };
    this.shown.set(name, one);
    if (!answer.t) {
      box.append(soft(answer.error || "no numbers in this time"));
      return;
    }
    one.plot = new uPlot(this.options(), columns(answer), box);
  }
  words(name, answer) {
    if (!answer.t) return `${name}: ${answer.error || "no numbers"}`;
    const [low, high] = [Math.min(...answer.low), Math.max(...answer.high)];
    return `${name}: from ${low} to ${high}, last ${answer.mean.at(-1)}`;
  }
  options() {
    const [soft_, grid, path] = ["soft", "grid", "path"].map(colour);
    const axis = { stroke: soft_, grid: { stroke: grid, width: 1 }, ticks: { show: false },
      font: "11px system-ui, sans-serif" };
    return {
      width: this.host.clientWidth, height: PLOT_HIGH, padding: [8, EDGE, 8, 0],
      legend: { show: false },
      cursor: { y: false, drag: { x: false, y: false, setScale: false }, points: { show: false } },
      scales: { x: { time: true, auto: false, min: this.span.start, max: this.span.end } },
      axes: [{ ...axis, show: false }, { ...axis, size: GUTTER, space: 26 }],
      series: [{}, { stroke: path, width: 0.5, points: { show: false } },
        { stroke: path, width: 1.5, points: { show: false } },
        { stroke: path, width: 0.5, points: { show: false } }],
      bands: [{ series: [3, 1], fill: path + "40" }],
      hooks: { ready: [(plot) => this.follow(plot)] },
    };
  }
  follow(plot) {
    const t = (event) => plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x");
    plot.over.addEventListener("pointermove", (event) => this.told.time(t(event), false));
    plot.over.addEventListener("pointerleave", () => this.told.time(null, false));
    plot.over.addEventListener("click", (event) => this.told.time(t(event), true));
  }
  resize() {
    const width = this.host.clientWidth;
    for (const { plot } of this.shown.values()) {
      if (plot && width && plot.width !== width) plot.setSize({ width, height: PLOT_HIGH });
    }
  }
  /* Other colours need other plots. */
  again() {
    for (const [name, { answer }] of [...this.shown]) {
      this.remove(name);
      this.make(name, answer);
    }
    this.move(this.span);
  }
}

/* What is known from a time on, and what came since: the newer answer begins at `from`. */
function joined(before, more, start) {
  if (!more.t) return before.t ? before : more;
  if (!before.t) return more;
  const isShown = before.t.map((each) => each >= start && each < more.from);
  const both = (key) => [...before[key].filter((_, n) => isShown[n]), ...more[key]];
  return { ...before, t: both("t"), low: both("low"), mean: both("mean"), high: both("high") };
}
/* Columns for uPlot, with a hole where nothing came for much longer than usual. */
function columns(answer) {
  const usual = answer.t.slice(1).map((each, n) => each - answer.t[n]).sort((a, b) => a - b);
  const longest = 4 * (usual[usual.length >> 1] || 1);
  const rows = [[], [], [], []];
  answer.t.forEach((t, n) => {
    if (n && t - answer.t[n - 1] > longest) {
      [(t + answer.t[n - 1]) / 2, null, null, null].forEach((each, k) => rows[k].push(each));
    }
    [t, answer.low[n], answer.mean[n], answer.high[n]].forEach((each, k) => rows[k].push(each));
  });
  return rows;
}
