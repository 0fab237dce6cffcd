/* The lists beside the map and below it: a moment, a stretch, things, events, state, questions. */

const ZONE = Intl.DateTimeFormat().resolvedOptions().timeZone;
const ONE = { gaps: "gap", "clock steps": "clock step", silences: "silence", errors: "error",
  "failed goals": "failed goal", "low batteries": "low battery", stops: "stop", "on/off changes": "on/off change", "speed drops": "speed drop",
  goals: "goal", sightings: "sighting" };
const SOUND = "no loss or fault was found";
const MISSED = "not_seen_where_expected";
const PROBLEMS = ["error", "failed goal", "low battery", "gap", "clock step", "silence"];
const FEW = 2;  // of one kind of problem, of which more are bundled
const LATEST = 4;

/* A time as short as the span that is shown allows. */
const when = (unix) => (date(state.span.start) === date(state.span.end) && date(unix) === date(state.span.end)
  ? timeOfDay(unix) : clock(unix));
function robotRows(robot, extra = []) {
  const rows = [];
  if (robot) rows.push(entry("Robot", metres(robot)));
  if (robot && robot.in) rows.push(entry("In", bdi(robot.in)));
  const yaw = robot ? robot.yaw_deg ?? robot.yaw : null;
  // That of a path goes on over 180, so that it can be interpolated.
  if (yaw !== null && yaw !== undefined) {
    rows.push(entry("Heading", `${Math.round(yaw - 360 * Math.round(yaw / 360))}\u00b0`));
  }
  return [...rows, ...extra];
}
/* A sentence of the server with its times and lengths as they are on the page. */
const inWords = (note) => note.replace(/\((\d[\d.]*(?:e[+-]?\d+)?) s\)/g, (_, s) => `(${lasting(Number(s))})`)
  .replace(/\b\d{9,10}\.\d{6}\b/g, (unix) => clock(Number(unix)));
function notesOf(notes) {
  const rows = (notes || []).map((each) => el("li", { class: "soft" }, inWords(each)));
  return rows.length ? [el("details", {}, el("summary", {}, counted(rows.length, "note")),
    el("ul", {}, ...rows))] : [];
}

/* `seen`: what was in view; a click shows the sightings of a label. */
function seenRows(seen, choose) {
  return seen.map((each) => pair(link(each.label, () => choose(each.label)),
    each.end - each.t >= 1 ? `for ${lasting(each.end - each.t)}` : ""));
}

function showMoment(host, answer, robot, choose) {
  const extra = answer.frame ? [entry("Frame", bdi(answer.frame))] : [];
  for (const each of answer.seen) delete each.end;  // only what is around the moment was looked at
  if (answer.speed !== null) extra.push(entry("Speed", `${answer.speed.toFixed(2)} m/s`));
  for (const [name, value] of Object.entries(answer.state)) {
    extra.push(entry(name, bdi(value === true ? "yes" : value === false ? "no" : value)));
  }
  const changes = answer.changes.map((each) => pair(bdi(each.text),
    each.before_s < 0 ? `${lasting(each.before_s)} later` : `${lasting(each.before_s)} before`));
  refill(host, el("dl", {}, ...robotRows(answer.robot || robot, extra)),
    el("h3", {}, "It saw"), ...(answer.seen.length ? listing(seenRows(answer.seen, choose), 8)
      : [soft("Nothing.")]),
    ...(changes.length ? [el("h3", {}, "What changed around it"), ...listing(changes)] : []),
    ...notesOf(answer.notes));
}
function showStretch(host, answer, choose, point) {
  const rows = [entry("Length", lasting(answer.end - answer.start))];
  if (answer.distance_m !== null) rows.push(entry("Driven", far(answer.distance_m)));
  if (answer.stood_s !== null) rows.push(entry("Stood", lasting(answer.stood_s)));
  refill(host, el("dl", {}, ...rows), el("h3", {}, "It saw"),
    ...(answer.seen.length ? listing(seenRows(answer.seen, choose), 8) : [soft("Nothing.")]),
    ...(answer.events.length ? [el("h3", {}, "What happened"),
      ...listing(eventRows(answer.events, point))] : []),
    ...notesOf(answer.notes));
}
function showSightings(host, answer, point) {
  const rows = answer.sightings.map((each) => {
    const where = each.place || each.robot;
    const place = where ? `${each.place ? "" : "robot at "}${metres(where)}` : "";
    return pair(link(when(each.last_seen), () => point(each.last_seen)),
      `${place}${each.in ? ` in ${each.in}` : ""}`);
  });
  const total = answer.total === null ? "there are more" : `${answer.total} in all`;
  refill(host,
    soft(answer.total === rows.length ? `${counted(rows.length, "sighting")}, newest first.`
      : `The newest ${rows.length} sightings, ${total}.`),
    ...listing(rows, 10), ...notesOf(answer.notes));
}
/* What is known of now without another question. */
function showNow(host, view, choose, point) {
  const { robot, path, range } = view;
  const newest = view.things.filter((each) => range.latest - each.last <= 5);
  const frame = path && path.frame ? [entry("Frame", bdi(path.frame))] : [];
  const seen = newest.map((each) => pair(link(each.label, () => choose(each)), metres(each)));
  const events = view.events.filter((each) => each.kind !== "thing").slice(-LATEST).reverse();
  refill(host,
    ...(robot ? [el("dl", {}, ...robotRows(robot, frame))] : [soft("Where the robot is, is not known.")]),
    ...(seen.length || (view.counts || {}).sightings
      ? [el("h3", {}, "In view"), ...(seen.length ? listing(seen, AT_ONCE) : [soft("Nothing.")])] : []),
    ...(events.length ? [el("h3", {}, "What happened last"), ...listing(eventRows(events, point))] : []));
}

function showThings(host, view, choose) {
  const seen = (each) => (isLive(view) ? agoOf(each.last, nowOf(view)) : when(each.last));
  const rows = view.things.map((each) => pair(
    el("span", {}, link(each.label, () => choose(each)), each.in ? ` in ${plain(each.in)}` : "",
      each.state === MISSED ? el("span", { class: "warn" }, " not seen where expected") : ""),
    el("span", {}, `${metres(each)} \u00b7 `, seen(each))));
  refill(host, ...(rows.length ? listing(rows, 10)
    : [soft((view.counts || {}).sightings || (view.throughout || []).length
      ? "What was seen has no place on the map. The timeline shows when it was in view."
      : "Nothing was seen in this time.")]));
}
function eventRows(events, point) {
  return events.map((each) => pair(
    link(each.in ? `${each.text} in ${each.in}` : each.text, () => point(each)),
    `${when(each.t)}${each.end > each.t ? `, ${lasting(each.end - each.t)}` : ""}`));
}
/* The sightings that were counted, the newest first, or of many those of each label; first what was
   in view all the time. */
function sightingRows(view, point, choose) {
  const { counts = {}, throughout = [] } = view;
  const always = new Set(throughout);
  const some = view.events.filter((each) => each.kind === "thing" && !always.has(each.label)).reverse();
  const all = throughout.map((label) => pair(link(`${label} in view`, () => choose(label)), "all the time"));
  const rows = [...all, ...eventRows(some, point)];
  const isWhole = (counts.sightings || 0) <= some.length;
  if (isWhole && !rows.length) return [];
  const { labels, total, notes } = view.seen || { labels: [], total: 0 };
  const byLabel = labels.map((each) => pair(link(each.label, () => choose(each.label)),
    `${counted(each.sightings, "sighting")}, ${lasting(each.seconds)}`));
  const left = total - labels.length;
  return [el("h3", {}, "Sightings"), ...listing(isWhole ? rows : byLabel, 6),
    ...(isWhole || left <= 0 ? [] : [soft(`${counted(left, "more label")} not listed.`)]),
    ...notesOf(notes)];
}
function showEvents(host, view, point, choose) {
  const shown = view.events.filter((each) => each.kind !== "thing").reverse();
  const { counts: some = {}, throughout = [] } = view;
  const seen = (some.sightings || 0) + throughout.length;
  const counts = Object.entries({ ...some, ...(seen ? { sightings: seen } : {}) })
    .map(([kind, n]) => `${n} ${n === 1 ? ONE[kind] || kind : kind}`).join(", ");
  const isProblem = (each) => PROBLEMS.includes(each.kind);
  const [problems, others] = [shown.filter(isProblem), shown.filter((each) => !isProblem(each))];
  refill(host, ...(counts ? [soft(counts)] : []),
    ...(problems.length ? [el("h3", {}, "Problems"), ...listing(bundled(problems, point))] : []),
    ...(problems.length && others.length ? [el("h3", {}, "All else")] : []),
    ...listing(eventRows(others, point), problems.length ? 4 : 8),
    ...sightingRows(view, point, choose),
    ...(shown.length || seen ? [] : [soft(view.isWhole ? "No events." : "Not known yet.")]),
    // That of fixes is drawn all the same.
    ...notesOf((view.notes || []).filter((each) => !view.path || !each.startsWith("the path is unknown"))));
}
/* Rows of events, the newest first; of a clock that was set often, one row for all. */
function bundled(events, point) {
  const steps = events.filter((each) => each.kind === "clock step");
  if (steps.length <= FEW) return eventRows(events, point);
  return events.filter((each) => each.kind !== "clock step" || each === steps[0])
    .map((each) => (each === steps[0] ? el("li", {}, el("details", {},
      el("summary", {}, `the clock was set ${steps.length} times, last at ${when(each.t)}`),
      el("ul", {}, ...eventRows(steps, point)))) : eventRows([each], point)[0]));
}

/* Topics of one kind, which may be many, in one line. */
function together(title, kind, status) {
  const topics = status[kind] || [];
  if (!topics.length) return [];
  const more = (status[kind + "_count"] || topics.length) - topics.length;
  const names = topics.flatMap((each, n) => [n ? ", " : "", bdi(each)]);
  return [el("p", { class: "warn" }, `! ${title}: `, ...names, more ? ` and ${more} more` : "")];
}
function faults(title, kind, range) {
  const files = range[kind];
  if (!files.length) return [];
  const rows = files.map((each) => el("li", {}, bdi(each.file), ": ", bdi(each.reason)));
  return [el("p", { class: "bad" }, `! ${title} (${range[kind + "_count"] || files.length})`),
    ...listing(rows)];
}
const recorderOf = (status) => (status.recorder === null ? "" : status.recorder
  + (status.restarts ? `, ${counted(status.restarts, "restart")}` : ""));

/* What is wrong, the worst first: lines for people. */
function troublesOf(status, range, now = status.now) {
  const warn = (...text) => el("p", { class: "warn" }, "! ", ...text);
  // The files are listed beside it.
  const doubts = status.doubts.replace(/; data_time_range (lists them|says why)/g, "");
  const rules = (status.rules || []).flatMap((each) => {
    const since = each.matches_since === undefined ? ""
      : `it has matched without an end since ${clock(each.matches_since)}`;
    const why = [each.problem, since].filter(Boolean).join("; ");
    return why ? [warn(`Rule ${each.rule}: ${why}`)] : [];
  });
  return [...faults("Damaged bags, not in the answers", "damaged", range),
    ...faults("Incomplete bags", "incomplete", range), ...faults("Unread bags", "unread", range),
    ...faults("Bags with a wrong clock", "clock_faults", range),
    ...(doubts === SOUND ? [] : [warn(doubts)]),
    ...status.fell_silent.map((each) => warn(bdi(each.topic), " fell silent ",
      agoOf(status.now - each.ago_s, now))),
    ...rules, ...together("Never heard", "never_heard", status),
    ...together("Offered by nobody", "missing", status)];
}
function showState(host, view) {
  const { status, range } = view;
  const now = nowOf(view);
  const own = status.budget.max_gb !== null;
  const recorder = recorderOf(status)
    || (own ? "no heartbeat yet" : state.recording ? "not shown for one recording"
      : "none in this deployment");
  const failing = status.recorder === "died";
  const budget = status.budget;
  const list = el("dl", {},
    entry("Recorder", el("span", { class: failing ? "bad" : "" }, recorder)),
    entry("Recorded", range.earliest === null ? "nothing" : recordedOf(view)),
    entry("Gaps", String(range.gaps.length)));
  if (own) {
    list.append(entry("Budget", `${size(budget.used_gb)} of ${size(budget.max_gb)}`,
      el("meter", { min: 0, max: budget.max_gb, value: budget.used_gb, "aria-label": "Budget used" })));
    if (budget.foreign_gb) list.append(entry("Foreign bags", size(budget.foreign_gb)));
    if (budget.growth_gb_per_day !== null) {
      list.append(entry("Growth", `${size(budget.growth_gb_per_day)} a day`));
    }
  } else list.append(entry("Size", size(budget.used_gb)));
  if (budget.full_in_days !== undefined) list.append(entry("Full in", `${budget.full_in_days} days`));
  for (const each of status.rules || []) {
    const last = each.last_ago_s === undefined ? [] : [", ", agoOf(status.now - each.last_ago_s, now)];
    list.append(entry(`Rule ${each.rule}`, `fired ${counted(each.fired, "time")}`, ...last, "; "
      + counted(each.moments, "moment") + (each.refused ? `, ${each.refused} refused` : "")));
  }
  const troubles = troublesOf(status, range, now);
  refill(host,
    ...(troubles.length || failing ? troubles : [el("p", { class: "good" }, `\u2713 ${SOUND}`)]), list,
    ...notesOf([...new Set([...(range.notes || []), ...(status.notes || [])])]),
    el("p", { class: "soft", id: "since" }));
  showSince(view);
}
/* From which moment every "ago" on the page counts. */
function showSince(view) {
  const since = isHalted(view) ? "the newest recorded moment" : "the time of this look";
  at("since").textContent = `\u201cAgo\u201d counts from ${since}, ${dated(nowOf(view))}. Time zone: ${ZONE}.`;
}

function showQuestions(host, questions) {
  const rows = questions.map((each) => el("li", {}, el("details", {},
    el("summary", {}, `${timeOfDay(each.asked)} ${plain(each.tool)} ${plain(each.arguments)}: `
      + `${each.outcome}, ${Math.round(each.ms)} ms`),
    el("pre", {}, each.answer))));
  refill(host, ...(rows.length ? listing(rows, 8) : [soft("None yet.")]));
}
