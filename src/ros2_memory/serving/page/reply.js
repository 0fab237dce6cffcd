/* What a reply of a tool holds that can be drawn, and the rows that are listed of it.

   A part has `points` (where the robot was), `things`, `places` and a `path` for the map, `bars` by
   lane and `events` for the timeline, and `rows`: a text, its time `at` and how `long` (s) it took or
   what else is `beside` it, and what a click would `ask`. */

const IN_VIEW = / in view$/;
const EVENTS = [["stop", /^stood at /], ["thing", IN_VIEW], ["silence", / (was|were) silent$/],
  ["gap", /^nothing (was recorded|is here)/], ["error", /^error: /], ["clock step", /^the clock was set/],
  ["drop", /^slowed down suddenly/], ["failed goal", / goal (canceled|aborted)/], ["goal", / goal /],
  ["low battery", / (fell|was) below \d+%$/]];
const STOOD = /^stood at x (-?[\d.]+), y (-?[\d.]+)$/;
const MISSING = "unknown";
const SAME_PLACE_M = 0.2;

const eventKind = (text) => (EVENTS.find(([, form]) => form.test(text)) || ["flip"])[0];
const within = (row) => (row.in ? ` in ${row.in}` : "");
const whose = (row) => (row.robot_name ? `${row.robot_name}: ` : "");
/* A value as a text; of a goal its status. */
const short = (value) => (typeof value === "string" ? value : value?.status ?? JSON.stringify(value) ?? "");
const spelled = (name) => name.replaceAll("_", " ");
const around = (t) => ["recap", { around: t }];
const during = (t, end) => (end > t ? ["recap", { start: t, end }] : around(t));
const about = (label) => ["find_things", { label }];

class Part {
  constructor(frame = null) {
    Object.assign(this, { frame, points: [], things: [], places: [], path: null, robot: null, events: [], rows: [] });
    this.bars = new Map();
  }
  bar(lane, t, end, text = lane) {
    if (!this.bars.has(lane)) this.bars.set(lane, []);
    this.bars.get(lane).push([t, end, text]);
  }
  list(title, rows) {
    if (rows.length) this.rows.push({ title }, ...rows);
  }
  /* The times of its lanes. */
  get times() {
    return [...[...this.bars.values()].flat(), ...this.events.map(({ t, end }) => [t, end ?? t])]
      .flatMap(([t, end]) => [t, end]).filter(Number.isFinite);
  }
}

/* Things without those of the same name that are where another is. */
function apartFromEachOther(things) {
  const found = [];
  for (const thing of things) {
    const isThere = (one) => one.label === thing.label && Math.hypot(one.x - thing.x, one.y - thing.y) < SAME_PLACE_M;
    if (!found.some(isThere)) found.push(thing);
  }
  return found;
}
/* The same hours of several days as one reply. */
function joined(reply) {
  if (!reply.windows) return reply;
  const lists = {};
  for (const part of reply.windows) {
    for (const [name, rows] of Object.entries(part)) {
      if (!Array.isArray(rows) || !rows.length || name === "notes") continue;
      const more = name === "waypoints" ? [{ ...rows[0], jump: true }, ...rows.slice(1)] : rows;
      lists[name] = [...(lists[name] || []), ...more];
    }
  }
  const [first, last] = [reply.windows[0], reply.windows.at(-1)];
  return { ...first, ...reply, ...reply.all, ...lists, start: first.start, end: last.end };
}

function addEvents(part, events) {
  for (const event of events) {
    const { timestamp: t, text, duration_s: long = 0 } = event;
    const end = long > 0 ? t + long : undefined;
    const said = whose(event) + text + within(event);
    const [, x, y] = STOOD.exec(text) || [];
    part.events.push({ kind: eventKind(text), t, end, text, label: text.replace(IN_VIEW, "") });
    if (x !== undefined) part.points.push({ x: Number(x), y: Number(y), t, end, hint: `${said}, ${clock(t)}` });
    part.rows.push({ text: said, at: t, long, ask: during(t, end) });
  }
}
function addPath(part, points, reply) {
  const [t, x, y, yaw] = ["timestamp", "x", "y", "yaw_deg"].map((name) => points.map((point) => point[name] ?? null));
  const begins = points.flatMap((point, n) => (!n || point.jump || point.entered ? [n] : []));
  for (let n = 1; n < yaw.length; n++) {  // they go on over 180, so that they can be interpolated
    if (yaw[n] !== null && yaw[n - 1] !== null) yaw[n] += 360 * Math.round((yaw[n - 1] - yaw[n]) / 360);
  }
  part.path = { t, x, y, yaw, begins, frame: reply.frame_id, whole: true, kind: "path" };
  if (t.length) part.robot = { x: x.at(-1), y: y.at(-1), yaw: yaw.at(-1) };
  begins.forEach((n, nth) => part.bar("path", t[n], t[(begins[nth + 1] ?? t.length) - 1]));
}
function addFarthest(part, found) {
  const text = `farthest: ${far(found.distance_m)}${within(found)}`;
  part.points.push({ x: found.x, y: found.y, t: found.timestamp, frame: found.frame_id, hint: text });
  part.rows.push({ text, at: found.timestamp, ask: around(found.timestamp) });
}
function addVisits(part, visits, reply) {
  for (const visit of visits) {
    const t = visit.arrived ?? visit.departed - visit.duration_s;
    const end = visit.departed ?? t + visit.duration_s;
    part.bar(reply.where || "visits", t, end, reply.where || "visit");
    part.rows.push({ text: `${whose(visit)}${visit.departed === null ? "still there" : reply.where || "visit"}`, at: t,
      long: visit.duration_s, ask: during(t, end) });
  }
  if (reply.x !== undefined) part.places.push({ name: "", circle: [reply.x, reply.y, reply.radius_m] });
}
function addThings(part, things, reply) {
  for (const thing of things) {
    const { label, place, first_seen: first = thing.last_seen, last_seen: last, moved = [], moved_times: moves } = thing;
    const text = whose(thing) + label + within(thing);
    part.things.push({ label, ...place, frame: thing.frame_id || reply.frame_id, hint: `${text}, last seen ${clock(last)}` });
    if (moved.length) moved.forEach((stay) => part.bar(label, stay.from, stay.to, label + within(stay)));
    else part.bar(label, first, last, `${label}, first to last seen`);
    part.rows.push({ text, at: last, beside: metres(place) + (moves ? `, moved ${counted(moves, "time")}` : ""), ask: about(label) });
  }
}
function addSightings(part, sightings, reply) {
  for (const sighting of sightings) {
    const { first_seen: t, last_seen: end, duration_s: long, robot, place, matched, value, topic = reply.topic } = sighting;
    const text = short(place?.label ?? matched?.[0] ?? value ?? topic);
    const hint = `${text}, ${clock(t)}`;
    if (place) part.things.push({ label: text, x: place.x, y: place.y, frame: place.frame_id, hint });
    else if (robot) part.points.push({ x: robot.x, y: robot.y, t, end, frame: robot.frame_id, hint });
    part.bar(place ? text : topic, t, Math.max(end, t + (long || 0)), text);
    part.rows.push({ text: whose(sighting) + text, at: t, long, ask: during(t, end) });
  }
}
function addEpisodes(part, episodes) {
  for (const episode of episodes) {
    const { start: t, end, seconds: long, robot } = episode;
    const text = short(episode.value);
    if (robot) part.points.push({ x: robot.x, y: robot.y, t, end, frame: robot.frame_id, hint: `${text}, ${clock(t)}` });
    part.bar(text, t, end);
    part.rows.push({ text: whose(episode) + text, at: t, long, ask: during(t, end) });
  }
}
/* The two windows that are compared, where the call has them in Unix seconds. */
function addWindows(part, { start, end, with_start: from, with_end: to }) {
  if ([start, end].every(Number.isFinite)) part.bar("this", start, end, "this window");
  if ([from, to].every(Number.isFinite)) part.bar("other", from, to, "the other window");
}
/* Things of two windows: where a thing was, where it is, and a line between the two. */
function addDifferences(part, kinds, reply) {
  const path = { t: [], x: [], y: [], yaw: [], begins: [], frame: reply.frame_id, whole: true, kind: "moved" };
  for (const [kind, things] of Object.entries(kinds)) {
    if (!Array.isArray(things)) continue;
    part.list(spelled(kind), things.map(({ label, was, is }) => {
      const ends = [[was, was?.last_seen], [is, is?.first_seen ?? is?.last_seen]].filter(([spot]) => spot);
      const { x, y } = is || was;
      part.things.push({ label, x, y, frame: reply.frame_id, hint: `${label}, ${spelled(kind)}` });
      if (was && is) path.begins.push(path.t.length);
      for (const [spot, t] of ends) {
        part.bar(label, t, t, `${label}${within(spot)}, ${spot === was ? "before" : "after"}`);
        if (!was || !is) continue;
        for (const [column, number] of Object.entries({ t, x: spot.x, y: spot.y, yaw: null })) path[column].push(number);
      }
      return { text: label, beside: ends.map(([spot]) => metres(spot) + within(spot)).join(" \u2192 "), ask: about(label) };
    }));
  }
  if (path.t.length) part.path = path;
}
const both = (pair, format) => [["this"], ["with", "other "]]
  .map(([name, title = ""]) => title + (pair[name] === null ? MISSING : format(pair[name]))).join(", ");
const plainly = (number) => String(Number(number.toFixed(2)));
const pairs = (found) => Object.entries(found).map(([text, pair]) => ({ text, beside: both(pair, plainly) }));
function addStandstills(part, stood) {
  part.list("stood", stood.map((spot) => {
    part.points.push({ x: spot.x, y: spot.y, hint: `stood${within(spot)}: ${both(spot, lasting)}` });
    return { text: metres(spot) + within(spot), beside: both(spot, lasting) };
  }));
}
function addTable(part, columns, rows) {
  part.rows.push(...rows.map(([first, ...cells]) => ({ text: short(first),
    beside: cells.map((cell, n) => `${columns[n + 1]} ${short(cell)}`).join(", ") })));
}
function addChanges(part, { around: t, before, after = [], state = {} }) {
  part.list("What changed around it", [
    ...before.map(({ text, s_before: by }) => ({ text, beside: `${lasting(by)} before`, ask: around(t - by) })),
    ...after.map(({ text, s_after: by }) => ({ text, beside: `${lasting(by)} after`, ask: around(t + by) }))]);
  part.list("State", Object.entries(state).map(([name, value]) => ({ text: name, beside: short(value) })));
}

/* A reply as one part; `given` are the arguments that were asked with. */
function partOf(reply, given = {}) {
  const part = new Part(reply.frame_id);
  const { things, robot, places, columns, rows, visits, before, waypoints, farthest, events, sightings, episodes } = reply;
  if (reply.error) part.rows.push({ text: reply.detail || reply.error });
  if (events) addEvents(part, events);
  if (waypoints) addPath(part, waypoints, reply);
  if (farthest) addFarthest(part, farthest);
  if (Array.isArray(visits)) addVisits(part, visits, reply);
  if (sightings) addSightings(part, sightings, reply);
  if (episodes) addEpisodes(part, episodes);
  if (reply.duration_s instanceof Object) addWindows(part, given);
  if (Array.isArray(things)) addThings(part, things, reply);
  else if (things) addDifferences(part, things, reply);
  if (reply.stood_at) addStandstills(part, reply.stood_at);
  for (const name of ["way", "errors", "silent_s"]) if (reply[name]) part.list(PAIRS[name], pairs(reply[name]));
  if (reply.minutes instanceof Object) part.list("Minutes in places", pairs(reply.minutes));
  if (places) part.rows.push(...places.map((row) => ({ text: whose(row) + row.place,
    beside: `${lasting(60 * row.minutes)}, ${row.entries} entries, ${row.exits} exits` })));
  if (columns && rows) addTable(part, columns, rows);
  if (Array.isArray(before)) addChanges(part, reply);
  if (robot) Object.assign(part, { robot: { x: robot.x, y: robot.y, yaw: robot.yaw_deg }, frame: robot.frame_id });
  return part;
}
const PAIRS = { way: "Path", errors: "Errors", silent_s: "Silent, in seconds" };

const mps = (speed) => `${speed.toFixed(2)} m/s`;
const NUMBERS = { distance_m: ["Driven", far], max_speed: ["Top speed", mps], avg_speed: ["Mean speed", mps],
  stood_s: ["Stood", lasting], duration_s: ["Length", lasting], recorded_s: ["Recorded", lasting],
  total: ["In all", String], at_least: ["At least", String], entries: ["Entries", String], exits: ["Exits", String],
  there_now: ["There now", (is) => (is ? "yes" : "no")], minutes: ["There for", (minutes) => lasting(60 * minutes)],
  unknown_s: ["Not known for", lasting], things_unchanged: ["Unchanged things", String] };
/* The numbers of a whole reply, as terms and texts. */
function numbersOf(reply) {
  return Object.entries(NUMBERS).flatMap(([name, [term, format]]) => {
    const value = reply[name] ?? null;
    if (value === null || (value instanceof Object && value.this === undefined)) return [];
    return [[term, value instanceof Object ? both(value, format) : format(value)]];
  });
}
/* The time that a reply is about: its own, or from the first of its rows to the last. */
function spanOf(reply, { times }) {
  const { around: t, seconds_before: by } = reply;
  const start = reply.start ?? (t === undefined ? times.reduce((a, b) => Math.min(a, b), Infinity) : t - by);
  const end = reply.end ?? t ?? times.reduce((a, b) => Math.max(a, b), -Infinity);
  return Number.isFinite(start) && Number.isFinite(end) ? { start, end: Math.max(end, start + 1) } : null;
}
