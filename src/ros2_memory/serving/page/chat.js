/* A reply in the chat of a client with MCP Apps (SEP-1865 of 2026-01-26): what the host sends is
   drawn, and all that is asked further goes through the host. */

const VERSION = "2026-01-26";
const RPC = "2.0";
const MOST_ROWS = 8;
const MOST_POINTS = 200;  // of a path: far more than a planner reads
const NOT_KNOWN = -32601;
const TITLES = { recap: "What happened", trajectory_summary: "Path", find_things: "Things" };

const waiting = new Map();  // by the number of a request: what takes its result
let requests = 0;
const shown = { name: "", given: {}, replies: [], span: null, frame: null, canAsk: false, isAsking: false };

const post = (message) => window.parent.postMessage({ jsonrpc: RPC, ...message }, "*");
function request(method, params) {
  const id = ++requests;
  post({ id, method, params });
  return new Promise((resolve, reject) => { waiting.set(id, { resolve, reject }); });
}
const HEARD = {
  "ui/notifications/tool-input": ({ arguments: given }) => { shown.given = given; },
  "ui/notifications/tool-result": (result) => {
    shown.replies = [{ given: shown.given, reply: read(result) }];
    show();
  },
  "ui/notifications/tool-cancelled": ({ reason }) => title(`No reply: ${reason || "cancelled"}`),
  "ui/notifications/host-context-changed": adapt,
};
window.addEventListener("message", ({ source, data }) => {
  if (source !== window.parent || !data || data.jsonrpc !== RPC) return;
  const { id, method, params = {}, result, error } = data;
  if (method === undefined) {
    const { resolve, reject } = waiting.get(id) || {};
    waiting.delete(id);
    if (error) reject?.(new Error(error.message));
    else resolve?.(result);
  } else if (id === undefined) HEARD[method]?.(params);
  else if (method === "ping" || method === "ui/resource-teardown") post({ id, result: {} });
  else post({ id, error: { code: NOT_KNOWN, message: "no such method" } });
});

/* The reply in a result: its one text is JSON, unless the host has put something else there. */
function read({ content = [] }) {
  const text = content.find(({ type }) => type === "text")?.text ?? "";
  try {
    return joined(JSON.parse(text) ?? { error: "never", detail: "Never, in what was searched." });
  } catch {
    return { error: "no reply", detail: text || "The reply is empty." };
  }
}
/* The host's colour scheme, and the tool that was called. */
function adapt({ theme, toolInfo }) {
  if (theme) {
    document.documentElement.style.colorScheme = theme;
    const [{ cssRules }] = document.styleSheets;
    const dark = [...cssRules].find(({ media }) => media && /scheme|all/.test(media.mediaText));
    dark.media.mediaText = theme === "dark" ? "all" : "not all";
  }
  if (toolInfo) shown.name = toolInfo.tool.title || toolInfo.tool.name;
  map.draw();
  line.draw();
}
async function ask([tool, given]) {
  if (!shown.canAsk || shown.isAsking) return;
  shown.isAsking = true;
  at("asked").className = "soft";
  at("asked").textContent = plain(`Asking ${tool} ${JSON.stringify(given)}`);
  try {
    const reply = read(await request("tools/call", { name: tool, arguments: given }));
    shown.replies.push({ tool, given, reply });
    show();
  } catch (error) {
    at("asked").className = "warn";
    at("asked").textContent = plain(`${tool} was not asked: ${error.message}`);
  } finally {
    shown.isAsking = false;
  }
}

/* Of the whole time; the path in the frame of what the map has. */
function askOfAll(tool) {
  const asPath = { max_waypoints: MOST_POINTS, ...(shown.frame ? { frame_id: shown.frame } : {}) };
  ask([tool, { ...shown.span, ...(tool === "trajectory_summary" ? asPath : {}) }]);
}

const map = new RobotMap(at("map"), { time: pointed, thing: ({ label }) => ask(about(label)),
  stretch: ({ t, end }) => t !== undefined && ask(during(t, end)), closer: () => {} });
const line = new Timeline(at("timeline"), { span: () => {}, time: pointed, labels: () => {},
  stretch: ({ t, end }) => ask(during(t, end)), label: () => {} });
function pointed(t, isChosen) {
  map.place(t);
  line.mark(t);
  if (isChosen && t !== null) ask(around(t));
}

const title = (text) => { at("title").textContent = plain(text); };
const isOneDay = ({ start, end }) => day(start) === day(end);
const when = (unix) => (shown.span && isOneDay(shown.span) ? timeOfDay(unix) : clock(unix));
const fromTo = (span) => `${dated(span.start)} to ${isOneDay(span) ? timeOfDay(span.end) : dated(span.end)}`;

/* Draws the first reply, with what further ones know of the same. */
function show() {
  const parts = shown.replies.map(({ reply, given }) => partOf(reply, given));
  const [{ reply: first }] = shown.replies;
  const further = shown.replies.length > 1 ? shown.replies.at(-1) : null;
  shown.span = spanOf(first, parts[0]);
  hasYears = shown.span !== null && yearOf(shown.span.start) !== yearOf(shown.span.end);
  title([shown.name, shown.span && fromTo(shown.span)].filter(Boolean).join(", "));
  showMap(parts);
  showLine(parts[0]);
  showReply("", first, parts[0]);
  at("more").hidden = !shown.canAsk || !shown.span;
  at("asked").textContent = "";
  at("further").hidden = !further;
  if (!further) return;
  at("further-title").textContent = plain(titleOf(further));
  showReply("further-", further.reply, parts.at(-1));
}
function titleOf({ tool, given: { around: t, start, end, label } }) {
  if (label !== undefined) return label;
  if (t !== undefined) return `${TITLES[tool]} around ${when(t)}`;
  return `${TITLES[tool]}${start === undefined ? "" : `, ${fromTo({ start, end })}`}`;
}
function showReply(prefix, reply, { rows }) {
  at(`${prefix}numbers`).replaceChildren(...numbersOf(reply).map(([term, text]) => entry(term, text)));
  const notes = reply.notes || [];
  at(`${prefix}rows`).replaceChildren(...lists(rows), ...(notes.length ? [el("details", rows.length ? {} : { open: "" },
    el("summary", {}, counted(notes.length, "note")), el("ul", {}, ...notes.map((note) => el("li", {}, note))))] : []));
}
/* Rows as lists, which have their titles above. */
function lists(rows) {
  const begins = rows.flatMap((row, n) => (!n || row.title ? [n] : []));
  return begins.flatMap((from, n) => {
    const some = rows.slice(from, begins[n + 1]);
    const name = some[0].title ? [el("h3", {}, some.shift().title)] : [];
    return [...name, ...listing(some.map(listed), MOST_ROWS)];
  });
}
function listed({ text, at: t, long, beside, ask: question }) {
  const parts = [beside, t === undefined ? "" : when(t), long > 0 ? lasting(long) : ""];
  return pair(question && shown.canAsk ? link(text, () => ask(question)) : bdi(text), parts.filter(Boolean).join(", "));
}

/* All that the replies have, in one frame: that of the newest path, else of the newest reply with one. */
function showMap(parts) {
  const newest = (name) => parts.map((part) => part[name]).findLast((some) => some && some.length !== 0);
  const all = (name) => parts.flatMap((part) => part[name].map((one) => ({ ...one, frame: one.frame ?? part.frame })));
  const [path, places = [], robot = null] = ["path", "places", "robot"].map(newest);
  const frame = path?.frame ?? newest("frame") ?? [...all("things"), ...all("points")].find((one) => one.frame)?.frame ?? null;
  const here = (name) => all(name).filter((one) => (one.frame ?? frame) === frame).map((one) => ({ ...one, frame }));
  shown.frame = frame;
  const view = { things: apartFromEachOther(here("things")), places, robot, no_path: path ? "" : "none",
    events: here("points").map((point) => ({ ...point, kind: "stop" })),
    path: path || { t: [], x: [], y: [], yaw: [], begins: [], frame, whole: true } };
  at("map-part").hidden = !(view.path.t.length || view.things.length || view.events.length || places.length || robot);
  map.show(view);
  const { label } = shown.replies.at(-1).given || {};
  map.choose(view.things.find((thing) => thing.label === label) || null);
  const one = (kind, text) => el("span", {}, el("i", { class: kind }), text);
  const keys = [path && one("", path.kind), view.events.length && one("stood", "where the robot was"),
    view.things.length && one("seen", "things"), places.length && one("place", "the place"),
    robot && one("now", "robot"), frame && el("span", {}, "frame ", bdi(frame))];
  at("map-key").replaceChildren(...keys.filter(Boolean));
}
function showLine({ bars, events }) {
  at("time-part").hidden = !shown.span || !(bars.size || events.length);
  if (at("time-part").hidden) return;
  const { start, end } = shown.span;
  const labels = [...bars].map(([label, its]) => ({ label, bars: its }));
  line.show({ isReply: true, events, moments: [], seen: { labels, until: -Infinity },
    range: { earliest: start, latest: end, gaps: [] } }, { start, end });
}

at("map-in").addEventListener("click", () => map.zoom(1.4));
at("map-out").addEventListener("click", () => map.zoom(1 / 1.4));
at("map-fit").addEventListener("click", () => map.fit());
for (const tool of Object.keys(TITLES)) {
  at("more").append(el("button", { type: "button", click: () => askOfAll(tool) }, TITLES[tool]));
}
// The wheel scrolls the chat; with Ctrl it zooms.
document.addEventListener("wheel", (event) => { if (!event.ctrlKey) event.stopPropagation(); }, { capture: true });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => adapt({}));

(async () => {
  const { hostCapabilities = {}, hostContext = {} } = await request("ui/initialize", { protocolVersion: VERSION,
    appInfo: { name: "ros2-memory", version: VERSION }, appCapabilities: { availableDisplayModes: ["inline", "fullscreen"] } });
  shown.canAsk = Boolean(hostCapabilities.serverTools);
  adapt(hostContext);
  post({ method: "ui/notifications/initialized", params: {} });
  new ResizeObserver(() => post({ method: "ui/notifications/size-changed", params: { width: window.innerWidth,
    height: Math.ceil(document.documentElement.getBoundingClientRect().height) } })).observe(document.documentElement);
})();
