/* What is shown, where it comes from, and what follows what: the only state of the page. */

const POLL_MS = 2000;
const FILLING_MS = 4000;
const REST_MS = 200;
const CLOSER_MS = 120;
const OVERLAP_S = 15;  // of the newest events, some go on
const STATUS_MS = 60000;
const LIVE_S = 600;  // a bag may be readable only when it is closed
const MOST_DUTY = 100;  // what is of the whole span is looked up in at most a hundredth of the time

const state = {
  view: null,
  last: 3600,  // seconds of a live page; null for a chosen span
  span: null,
  t: null,  // the chosen time; null for now
  recording: "",  // the name of the only one that is shown; empty for all
  poses: "",  // the topic that places the robot; empty for the configured one
  placing: null,  // which topics can place the robot
  hovered: null,
};
let asking = null;  // cancels the running look
let isLooking = false;
let wholeAt = 0;
let isWholeOwed = false;
let statusAt = 0;
let pause = FILLING_MS;
let lookedAt = 0;
const running = new Map();  // by kind: cancels what is asked besides a look
let closest = {};  // what was asked last of the path
let lookLater = 0;
let restLater = 0;
let turn = 0;  // of questions about a moment

const map = new RobotMap(at("map"), { time: pointed, thing: (each) => chooseThing(each),
  stretch: chooseStretch, closer });
const line = new Timeline(at("timeline"), { span: spanned, time: pointed, stretch: chooseStretch,
  label: (each) => chooseLabel(each), labels: offerLabels });
const plots = new Plots(at("plots"), { time: pointed, changed: () => remember() });

/* The address has what is shown: #last=3600, or #from=...&to=..., with &at=..., &recording=...,
   &poses=... and &plot=... */
function remember() {
  const given = new URLSearchParams();
  if (state.last !== null) given.set("last", state.last);
  else {
    given.set("from", state.span.start.toFixed(3));
    given.set("to", state.span.end.toFixed(3));
  }
  if (state.t !== null) given.set("at", state.t.toFixed(3));
  for (const [name, value] of Object.entries(chosenPart())) given.set(name, value);
  for (const each of plots.names) given.append("plot", each);
  const hash = `#${given}`;
  if (location.hash !== hash) history.replaceState(null, "", hash);
}
function readAddress() {
  const given = new URLSearchParams(location.hash.slice(1));
  const number = (name) => (given.has(name) && isTime(Number(given.get(name)))
    ? Number(given.get(name)) : null);
  const [from, to] = [number("from"), number("to")];
  if (given.get("last") === "all") state.last = "all";
  else state.last = number("last") || 3600;
  if (from !== null && to !== null && from < to) {
    state.last = null;
    state.span = { start: from, end: to };
  }
  state.t = number("at");
  state.recording = given.get("recording") || "";
  state.poses = given.get("poses") || "";
  plots.use(given.getAll("plot"));
}

/* Which part of the memory is looked at, and by which topic: so for all that is asked. */
function chosenPart() {
  return { ...(state.recording ? { recording: state.recording } : {}),
    ...(state.poses ? { poses: state.poses } : {}) };
}
function query() {
  const given = new URLSearchParams();
  if (state.last === null) {
    given.set("start", state.span.start.toFixed(3));
    given.set("end", state.span.end.toFixed(3));
  } else given.set("last", state.last === "all" ? 9e9 : state.last);
  for (const each of plots.names) given.append("signal", each);
  for (const [name, value] of Object.entries(chosenPart())) given.set(name, value);
  given.set("named", "1");
  return given;
}

/* Looks anew at the whole span, or only for what is newer than what is shown. */
async function look(isMore = false, isPatient = false) {
  if (asking) asking.abort();
  const mine = asking = new AbortController();
  const given = query();
  const { view, recording, poses } = state;
  lookedAt = Date.now();
  if (isPatient) given.set("patient", "1");
  if (!view) given.set("first", "1");
  if (isMore) {
    const isOld = Date.now() - statusAt > STATUS_MS;
    const isDue = Date.now() - wholeAt >= MOST_DUTY * (view.whole_ms || 0);
    given.set("version", isOld || (isDue && isWholeOwed) ? "" : view.version);
    if (!isOld) given.set("status", "0");
    const since = Math.max(Math.min(view.end, view.range.latest) - OVERLAP_S, view.start);
    given.set("since", view.owed === null ? since : Math.min(since, view.owed));
    if (view.owed !== null) given.set("patient", "1");
    if (!isDue) given.set("things", "0");
  }
  isLooking = true;
  at("summary").setAttribute("aria-busy", "true");
  try {
    const reply = await asked("/page/span", given, mine.signal);
    if (mine !== asking) return;
    at("locked").hidden = true;
    at("trouble").hidden = true;
    if (reply.unchanged) {
      view.range.now = reply.now;
      showSummary();
      return;
    }
    lookedAt = Date.now();
    isWholeOwed = reply.whole_ms === undefined;
    if (!isWholeOwed) wholeAt = lookedAt;
    if (reply.status) statusAt = lookedAt;
    if (reply.events) {
      reply.events.forEach((each) => uncut(each, reply.range || view.range));
      reply.events.push(...always(reply, reply.range || view.range));
    }
    // Of the same span, what there was no time for stays as it was.
    const of = [recording, poses, state.last, state.last === null ? given.get("start") + given.get("end") : ""].join();
    state.view = isMore && view && view.path !== undefined ? continued(view, reply)
      : whole(reply, view && view.asked === of ? view : null);
    Object.assign(state.view, { recording, poses, asked: of });
    // Of another span, or of more of it, the path is looked up anew; what came since goes on from it.
    const { start, path } = state.view;
    state.view.of = isMore ? view.of : [recording, poses, start, path && path.whole, Boolean(state.view.filling)].join();
    show(reply, isMore);
    if (state.view.range.earliest === null) return;
    if (reply.status) lookAtTopics();
    if (reply.whole_ms !== undefined) lookAtLabels();
    // What takes long comes later: the rest can be looked at until then.
    const isPart = reply.range && reply.range.earliest !== null && !isWhole(reply, given);
    if (isPart && !isPatient && (!view || !reply.filling)) setTimeout(() => look(false, !reply.filling), 50);
  } catch (error) {
    if (mine !== asking || error.name === "AbortError") return;
    if (error instanceof Locked) lock(error);
    else {
      showRecordings(state.view || {});
      if (!state.view) at("summary").textContent = "";
      at("trouble").textContent = plain(error.message);
      at("trouble").hidden = false;
    }
  } finally {
    if (mine === asking) {
      isLooking = false;
      at("summary").setAttribute("aria-busy", "false");
    }
  }
}
/* Cancels the last question of a kind: another one takes its place. */
function onlyLast(kind) {
  if (running.has(kind)) running.get(kind).abort();
  running.set(kind, new AbortController());
  return running.get(kind).signal;
}
/* The topics of the span, after what else is shown of it. */
async function lookAtTopics() {
  const { view, recording, span } = state;
  try {
    const reply = await asked("/page/topics", { start: span.start.toFixed(3), end: span.end.toFixed(3),
      ...(recording ? { recording } : {}) }, onlyLast("topics"));
    if (view.recording !== state.recording) return;
    showTopics(at("topics"), reply, plotAlso);
    state.placing = reply;
    const [only, ...others] = reply.places_robot;
    if (state.view.no_path && !state.poses && only && !others.length) placeBy(only.topic);
    else showKey();
  } catch (error) {
    if (error instanceof Locked) lock(error);
    else if (error.name !== "AbortError") at("topics").replaceChildren(soft(error.message));
  }
}
/* When each label was in view: all sightings, of which the events have the longest. */
async function lookAtLabels() {
  const { recording, span } = state;
  try {
    const { labels, labels_total, end, notes } = await asked("/page/labels", { ...chosenPart(),
      start: span.start.toFixed(3), end: span.end.toFixed(3) }, onlyLast("labels"));
    const { view } = state;
    if (recording !== state.recording || span.start !== state.span.start) return;
    view.seen = { labels, total: labels_total, notes, until: Math.min(end, view.range.latest) };
    line.show(view, state.span);
    showEvents(at("events"), view, chooseStretch, chooseLabel);
  } catch (error) {
    if (error instanceof Locked) lock(error);  // else the rows are by the events alone
  }
}
/* The path as it was driven where the map shows it, once the map rests. */
function closer(box, since) {
  const { span, view } = state;
  const { of } = view;
  const given = { ...chosenPart(), ...box, start: (since ?? span.start).toFixed(3),
    end: Math.max(span.end, view.end).toFixed(3) };
  const asking = `${new URLSearchParams(given)} ${of}`;
  if (closest.asking === asking) return;
  clearTimeout(closest.timer);
  const mine = { asking };
  closest = mine;
  mine.timer = setTimeout(async () => {
    try {
      const reply = await asked("/page/path", given);
      if (closest !== mine) return;
      map.enlarge(box, reply, since, of);
      showKey();
    } catch (error) {
      if (error instanceof Locked) lock(error);  // else the path stays as the first look has it
    }
  }, CLOSER_MS);
}
function offerLabels(number) {
  at("all-labels").hidden = number <= MOST_LABELS;
  at("all-labels").textContent = line.hasAll ? `Only the ${MOST_LABELS} labels seen longest`
    : `All ${number} labels`;
}
function plotAlso(name) {
  plots.use([...plots.names, name]);
  remember();
  look();
  at("plots").scrollIntoView({ block: "nearest" });
}
function placeBy(topic) {
  state.poses = topic;
  pointed(null, true);
  map.fit();
  remember();
  look();
}
/* A gap is as long as it was, also where the span begins or ends in it. */
function uncut(event, { gaps }) {
  const whole = event.kind === "gap" && gaps.find(([start, end]) => start <= event.t + 0.01 && end >= event.end - 0.01);
  if (whole) [event.t, event.end] = whole;
}
/* What was in view all the time is no event: the timeline has it wherever something was recorded. */
function always(reply, range) {
  const from = Math.max(reply.events_since, range.earliest);
  const to = Math.min(reply.end, reply.latest);
  const gaps = range.gaps.filter(([start, end]) => end > from && start < to);
  const begins = [from, ...gaps.map(([, end]) => end)];
  const ends = [...gaps.map(([start]) => start), to];
  const spans = begins.map((t, n) => ({ t, end: ends[n] })).filter(({ t, end }) => t < end);
  return reply.throughout.flatMap((label) => spans.map(
    (span) => ({ kind: "thing", ...span, label, text: `${label} in view` })));
}
/* Whether an answer has all that was asked for, and that takes long. */
function isWhole(reply, given) {
  return Boolean(reply.events && reply.path !== undefined && (reply.things || given.get("things") === "0"));
}
function whole(reply, before) {
  const { path = null, seen = null, robot = null, places = [], things = [], events = [] } = before || {};
  return { path, seen, robot, places, things, events, moments: [], owed: null, ...reply,
    isWhole: isWhole(reply, new URLSearchParams()) };
}
/* What is shown, with an answer about what came since. */
function continued(view, reply) {
  const next = { ...view, ...reply, things: reply.things || view.things };
  next.range = reply.range || { ...view.range, now: reply.now, latest: reply.latest };
  const since = reply.since;
  // Since when the server had no time to answer all: the next look asks for that again.
  next.owed = reply.events && reply.path !== undefined ? null : since;
  const older = view.path ? lastBefore(view.path.t, since - 0.001) + 1 : 0;
  const path = reply.path || null;
  next.path = path || view.path;
  if (path && view.path && path.frame === view.path.frame) {
    const first = view.path.t.findIndex((each) => each >= reply.start);
    const from = first < 0 ? older : Math.min(first, older);
    const column = (name) => [...view.path[name].slice(from, older), ...path[name]];
    const isNew = older === from || !path.continues;
    next.path = { ...path, t: column("t"), x: column("x"), y: column("y"), yaw: column("yaw"),
      begins: [...new Set([0, ...view.path.begins.filter((each) => each > from && each < older)
        .map((each) => each - from),
      ...path.begins.slice(isNew ? 0 : 1).map((each) => each + older - from)])] };
  }
  if (reply.events && reply.events_since <= reply.start) return next;
  const kept = view.events.filter((each) => each.t < since
    && (each.end === undefined ? each.t : each.end) >= reply.start);
  const more = (reply.events || []).filter((each) => {
    const begun = each.t <= since + 0.5 && kept.find((one) => one.kind === each.kind
      && (one.kind === "stop" || one.text === each.text)
      && (one.end === undefined || one.end >= since - 0.5));
    if (begun && each.end !== undefined) begun.end = Math.max(begun.end || 0, each.end);
    return !begun;
  });
  next.events = reply.events ? [...kept, ...more] : view.events;
  // Totals of the newest minute are not those of the span.
  for (const key of ["distance_m", "counts", "max_speed", "stood_s", "throughout"]) next[key] = view[key];
  return next;
}

function lock(error) {
  at("locked").hidden = false;
  at("memory").hidden = true;
  at("recording-part").hidden = true;
  at("summary").textContent = "";
  at("locked-why").textContent = token ? plain(error.message) : "";
  at("token").focus();
}

function show(reply, isMore) {
  const view = state.view;
  const { range, status } = view;
  latest = range.latest;
  hasYears = latest !== null && yearOf(range.earliest) !== yearOf(latest);
  showName(view);
  showState(at("state"), view);
  showSummary();
  showFilling(view.filling);
  showRecordings(view);
  at("questions-part").hidden = !view.questions;
  if (view.questions) showQuestions(at("questions"), view.questions);
  at("memory").hidden = at("length-part").hidden = range.earliest === null;
  if (range.earliest === null) return;
  state.span = state.last === null ? state.span : { start: view.start, end: view.end };
  map.show(view);
  line.show(view, state.span);
  plots.move(state.span);
  plots.show(reply.signals || [], isMore);
  showThings(at("things"), view, chooseThing);
  showEvents(at("events"), view, chooseStretch, chooseLabel);
  showKey();
  showSpan();
  showControls();
  if (state.t === null && !line.stretch && !map.chosen) showLatest();
  else if (!isMore && state.t !== null) pointed(state.t, true);
  place(state.hovered === null ? state.t : state.hovered);
  remember();
}
/* Of what this is the memory; where nothing is recorded, where that is looked for, and what to do. */
function showName({ memory, range, status }) {
  const name = state.recording || memory.name || "The robot's memory";
  at("name").replaceChildren(bdi(name));
  document.title = `${plain(name)} \u00b7 ros2-memory`;
  const isEmpty = range.earliest === null;
  at("empty").hidden = !isEmpty;
  if (!isEmpty) return;
  at("empty-why").replaceChildren(el("p", {}, "It is looked for in ", el("code", {}, memory.folder), "."),
    el("p", {}, status.budget.max_gb === null
      ? "Copy bags there, or serve another folder: " : "Start the recorder of this robot: ",
    el("code", {}, status.budget.max_gb === null ? "ros2-memory serve FOLDER" : "ros2-memory up"),
    ". This page looks again by itself."));
}
/* "Ago" counts from the newest recorded moment where "now" is that. */
const isHalted = ({ status }) => status.latest !== null && status.now === status.latest;
const nowOf = (view) => (isHalted(view) ? view.status.now : view.range.now);
/* How old the newest data is, also where "now" is when that was recorded; below 0: of a simulation. */
function ageOf(view) {
  return (isHalted(view) ? Date.now() / 1000 : view.range.now) - view.range.latest;
}
/* How much is recorded, where that is far less than from the first to the last. */
function recordedOf({ range, recordings = [], recordings_total: total = 0, recording }) {
  const whole = range.latest - range.earliest;
  const length = whole - range.gaps.reduce((sum, [start, end]) => sum + end - start, 0);
  const one = recordings.find((each) => each.name === recording);
  const number = recording ? (one && one.holds) || 1 : total - recordings.filter((each) => each.holds).length;
  if (length > whole / 2 || number < 2) return `${lasting(whole)} in ${counted(range.bags, "bag")}`;
  return `${lasting(length)} in ${counted(number, "recording")} over ${lasting(whole)}`;
}
/* Whether new data comes, or may come within minutes. */
function isLive(view) {
  return view.range.latest !== null && (view.status.recorder_alive || Math.abs(ageOf(view)) < LIVE_S);
}
function newestOf(view) {
  const { latest: newest, now } = view.range;
  if (isLive(view)) return `newest data ${isHalted(view) ? dated(newest) : ago(now - newest)}`;
  return `recorded until ${dated(newest)}${isHalted(view) ? "" : `, ${ago(now - newest)}`}`;
}
function showSummary() {
  const { range, status } = state.view;
  const sound = !troublesOf(status, range).length;
  const isSparse = range.latest !== null && recordedOf(state.view).includes(" over ");
  const parts = [state.recording ? "this recording alone" : recorderOf(status),
    range.latest === null ? "nothing is recorded" : newestOf(state.view),
    isSparse ? recordedOf(state.view) : ""].filter(Boolean);
  at("summary").replaceChildren(plain(parts.join(" \u00b7 ")), ...(range.latest === null ? [] : [" \u00b7 ", sound
    ? SOUND : el("span", { class: "warn" }, "! something is missing: see State")]));
  countAgo(nowOf(state.view));
  showSince(state.view);
  if (range.latest !== null && at("back").hidden && state.hovered === null) headOfNow();
}
function headOfNow() {
  const { view } = state;
  head(isLive(view) ? "Now" : "When recording ended", isLive(view) ? newestOf(view) : dated(view.range.latest));
}
/* Which recordings there are, and where those shown are plainly of several robots. */
function showRecordings(view) {
  const rows = view.recordings || [];
  const mixed = view.mixed || [];
  const hidden = (view.recordings_total || 0) - rows.length;
  const named = (each) => `${each.name}${each.holds ? ` (${counted(each.holds, "recording")})` : ""}, `
    + `${clock(each.start)}, ${lasting(each.end - each.start)}`;
  const all = hidden > 0 ? `all (newest ${rows.length} listed)` : "all";
  const options = [["", all], ...rows.map((each) => [each.name, named(each)])];
  if (!options.some(([value]) => value === state.recording)) {
    options.splice(1, 0, [state.recording, state.recording]);
  }
  at("recording-part").hidden = options.length < 3 && !state.recording;
  const names = options.map(([value, text]) => el("option", { value }, text));
  if (document.activeElement !== at("recording") || !at("recording").options.length) {
    at("recording").replaceChildren(...names);
  }
  at("recording").value = state.recording;
  at("ask-one").hidden = !state.recording;
  at("ask-one").replaceChildren("Answers are from the recording ", bdi(state.recording), " alone.");
  at("mixed").hidden = !mixed.length;
  at("mixed").replaceChildren(...mixed.map((each) => el("p", {}, `! ${each[0].toUpperCase()}${each.slice(1)}.`)),
    ...(mixed.length ? [el("p", {}, "The map joins their paths. Choose one recording above.")] : []));
}
function showFilling(filling) {
  at("filling").hidden = !filling;
  if (!filling) return;
  at("filled").value = filling.percent;
  at("filled-text").textContent = `Bags are being stored as columns: ${filling.percent} % of `
    + `${counted(filling.closed, "bag")}. Until then answers take longer.`;
}
function showKey() {
  const view = state.view;
  const one = (kind, text) => el("span", {}, el("i", { class: kind }), text);
  const more = (view.things_total || 0) > view.things.length ? ` of ${view.things_total}` : "";
  const { stops } = view.counts || {};  // the longest are among the events
  // Without poses there is no map: the reason is shown instead.
  const isEmpty = Boolean(view.no_path) && !(view.places || []).length;
  at("map").hidden = at("map-tools").hidden = isEmpty;
  if (state.placing) offerPoses(state.placing, view, state.poses);
  if (isEmpty) {
    at("map-key").replaceChildren(el("span", { class: "warn" }, at("poses-part").hidden || state.poses
      ? `No path: ${view.no_path}.` : "No path: which topic says where the robot is? Choose it above."));
    return;
  }
  const { path } = map;
  at("map-key").replaceChildren(...pathKey(view, one),
  ...(map.stops.length ? [one("stood", `stops, ${map.stops.length}${stops > map.stops.length ? ` of ${stops}` : ""}`)]
    : []),
  ...(map.things.length ? [one("seen", `things, ${map.things.length}${more}`)] : []),
  ...((view.places || []).length ? [one("place", "places")] : []),
  ...(path ? [el("span", {}, "frame ", bdi(path.frame || "without a name"))] : []),
  ...(path && !path.whole ? [el("span", { class: "warn" }, "older path is being read")] : []),
  ...((map.exactly() || { exact: true }).exact === false ? [el("span", {}, "older parts to 5 cm")] : []),
  ...(view.no_path ? [el("span", { class: "warn" }, `${view.no_path}.`)] : []));
}
function pathKey(view, one) {
  return [one("path", view.distance_m === null || view.distance_m === undefined
    ? "path" : `path, ${far(view.distance_m)}`), one("now", isLive(view) ? "robot now" : "robot at the end"),
  one("robot", "at the time pointed at")];
}
function showSpan() {
  const { start, end } = state.span;
  const to = date(start) === date(end) ? timeOfDay(end) : dated(end);
  at("span-text").textContent = `${dated(start)} to ${to} (${lasting(end - start)})`;
}
function showControls() {
  at("live").setAttribute("aria-pressed", String(state.last !== null));
  at("live").hidden = !isLive(state.view);
  const length = at("length");
  const value = state.last === null ? "other" : String(state.last);
  const known = [...length.options].some((each) => each.value === value);
  length.value = known ? value : "other";
}

/* Puts the robot, the marker of the timeline and those of the plots to a time. */
function place(t) {
  map.place(t);
  line.mark(t);
  plots.mark(t);
}
/* A time is pointed at, or chosen; null: no longer. */
function pointed(t, isChosen) {
  if (!state.view) return;
  if (isChosen) {
    state.t = t;
    state.hovered = null;
    line.choose(null);
    map.choose(null);
    remember();
  } else state.hovered = t;
  const shown = t === null ? state.t : t;
  place(shown);
  clearTimeout(restLater);
  turn++;
  if (!isChosen && (line.stretch || map.chosen)) return;
  if (shown === null) {
    headOfNow();
    showLatest();
    return;
  }
  head("At this time", dated(shown), state.t !== null);
  restLater = setTimeout(() => ask({ t: shown.toFixed(3) },
    (answer) => {
      map.correct(answer);
      showMoment(at("moment"), answer, map.at(shown), (label) => chooseLabel(label));
    }),
  isChosen ? 0 : REST_MS);
}
function showLatest() {
  showNow(at("moment"), state.view, chooseThing, chooseStretch);
}
function head(title, text, isChosen = false) {
  at("moment-title").textContent = plain(title);
  // The age of the newest data changes all the time: it is not read out.
  at("moment-time").setAttribute("aria-live", title === "Now" ? "off" : "polite");
  if (at("moment-time").textContent !== plain(text)) at("moment-time").textContent = plain(text);
  at("back").hidden = !isChosen;
}
async function ask(given, then) {
  const mine = ++turn;
  at("moment").setAttribute("aria-busy", "true");
  try {
    const answer = await asked("/page/moment", { ...given, ...chosenPart() });
    if (mine === turn) then(answer);
  } catch (error) {
    if (error instanceof Locked) lock(error);
    else if (mine === turn) at("moment").replaceChildren(soft(error.message));
  } finally {
    if (mine === turn) at("moment").setAttribute("aria-busy", "false");
  }
}
function chooseThing(thing) {
  map.choose(thing);
  line.choose(null);
  sightings(thing.label);
}
function chooseLabel(label) {
  const thing = state.view.things.find((each) => each.label === label);
  if (thing) map.choose(thing);
  sightings(label);
}
function sightings(label) {
  const { start, end } = state.span;
  head(label, `seen from ${clock(start)} to ${clock(end)}`, true);
  ask({ label, start: start.toFixed(3), end: end.toFixed(3) },
    (answer) => showSightings(at("moment"), answer, (t) => pointed(t, true)));
}
/* An event or a chosen stretch; one of no length is a time. */
function chooseStretch(event) {
  if (event.end === undefined || event.end <= event.t) { pointed(event.t, true); return; }
  clearTimeout(restLater);
  state.t = event.t;
  map.choose(null);
  place(event.t);
  line.choose(event);
  remember();
  head(event.text, `${clock(event.t)}, for ${lasting(event.end - event.t)}`, true);
  ask({ start: event.t.toFixed(3), end: event.end.toFixed(3) },
    (answer) => showStretch(at("moment"), answer, chooseLabel, chooseStretch));
}

/* The timeline was dragged or zoomed. */
function spanned(start, end, isDone) {
  state.last = null;
  state.span = { start, end };
  plots.move(state.span);
  showSpan();
  showControls();
  remember();
  clearTimeout(lookLater);
  lookLater = setTimeout(() => look(), isDone ? 60 : REST_MS);
}

at("unlock").addEventListener("submit", (event) => {
  event.preventDefault();
  keepToken(at("token").value.trim());
  at("token").value = "";
  look();
});
at("length").addEventListener("change", () => {
  const chosenLength = at("length").value;
  state.last = chosenLength === "all" ? "all" : Number(chosenLength);
  look();
});
at("recording").addEventListener("change", () => {
  state.recording = at("recording").value;
  state.poses = "";
  state.placing = null;
  state.last = state.recording ? "all" : state.last || "all";  // another one was at another time
  at("mixed").hidden = true;
  pointed(null, true);
  map.fit();
  remember();
  look();
});
at("live").addEventListener("click", () => {
  if (state.last === null) {
    const length = Math.round(state.span.end - state.span.start);
    state.last = Math.max(length, 1);
  } else {
    state.last = null;
    remember();
    showControls();
  }
  look();
});
// Not by its address, which has what is shown.
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  at("timeline").focus();
});
at("all-labels").addEventListener("click", () => {
  line.hasAll = !line.hasAll;
  line.show(state.view, state.span);
});
at("back").addEventListener("click", () => pointed(null, true));
at("map-in").addEventListener("click", () => map.zoom(1.4));
at("map-out").addEventListener("click", () => map.zoom(1 / 1.4));
at("map-fit").addEventListener("click", () => map.fit());
at("earlier").addEventListener("click", () => line.pan(-0.5));
at("later").addEventListener("click", () => line.pan(0.5));
at("time-in").addEventListener("click", () => line.zoom(2));
at("time-out").addEventListener("click", () => line.zoom(0.5));
at("poses").addEventListener("change", () => placeBy(at("poses").value));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  map.draw();
  line.draw();
  drawSpokes();
});
window.addEventListener("hashchange", () => { readAddress(); look(); });
document.addEventListener("visibilitychange", () => { if (!document.hidden) follow(); });

/* Looks for what is new, as long as somebody looks at the page. */
async function follow() {
  if (document.hidden || isLooking || !at("locked").hidden) return;
  const { view } = state;
  if (!view || view.recording !== state.recording || view.poses !== state.poses) {  // the last look failed
    if (Date.now() - lookedAt >= FILLING_MS) await look();
    return;
  }
  if (view.range.earliest === null) { await look(); return; }
  const isWhole = !view.filling && view.isWhole;
  if (isWhole) { pause = FILLING_MS; await look(true); return; }
  if (Date.now() - lookedAt < pause) return;
  pause = view.filling ? FILLING_MS : 2 * pause;  // what takes too long is asked for less and less
  await look(false, !view.filling);
}
readAddress();
look();
setInterval(follow, POLL_MS);
