/* The topics: how often each speaks, when it did, and its numbers, each a click from its plot. */

const MOST_ROWS = 12;
const MOST_CHIPS = 24;
const MOST_HZ = 1e5;  // of messages whose times are counters

/* The numbers of a topic, those of one message inside another together: `position` x y z. */
function chips(topic, plot) {
  const groups = new Map([["", []]]);  // those of the message itself come first
  for (const path of topic.numbers) {
    const cut = path.lastIndexOf(".");
    const group = path.slice(0, Math.max(cut, 0));
    if (!groups.has(group)) groups.set(group, []);
    groups.get(group).push(path);
  }
  const shown = [...groups].filter(([, paths]) => paths.length).flatMap(([group, paths]) => [
    ...(group ? [el("span", { class: "soft" }, bdi(group))] : []),
    ...paths.map((path) => el("button", { type: "button", class: "plain",
      "aria-label": `Plot ${plain(topic.topic)} ${plain(path)}`, title: `Plot ${plain(path)}`,
      click: () => plot(`${topic.topic}:${path}`) }, bdi(path.slice(group ? group.length + 1 : 0))))]);
  if (shown.length <= MOST_CHIPS) return [el("p", { class: "chips" }, ...shown)];
  return [el("p", { class: "chips" }, ...shown.slice(0, MOST_CHIPS)),
    el("details", {}, el("summary", {}, "more numbers"),
      el("p", { class: "chips" }, ...shown.slice(MOST_CHIPS)))];
}
function pace(rate) {
  if (rate === null) return "once";
  if (rate > MOST_HZ) return "at once";
  if (rate >= 0.1) return `${Number(rate.toPrecision(3))} Hz`;
  return `every ${lasting(1 / (rate || 0.001))}`;
}
function topicRow(topic, plot) {
  const bar = el("canvas", { class: "spoke", role: "img", "aria-label": spokeText(topic.spoke) });
  bar.spoke = topic.spoke;
  return el("li", {}, el("div", { class: "topic" },
    el("span", {}, bdi(topic.topic), " ", el("span", { class: "soft" }, bdi(topic.type))), bar,
    el("span", { class: "soft" }, `${pace(topic.rate_hz)} \u00b7 ${topic.count.toLocaleString()} ${topic.count === 1 ? "message" : "messages"}`)),
  ...(topic.numbers.length ? chips(topic, plot) : []));
}
function spokeText(spoke) {
  const heard = spoke.filter((each) => each).length;
  return heard ? `spoke in ${Math.round(100 * heard / spoke.length)} % of this time` : "silent in this time";
}
/* When a topic spoke in the span that is shown: darker where it did more often. */
function drawSpoke(bar) {
  const { context: c, width, height } = sharp(bar);
  const most = Math.max(...bar.spoke);
  const wide = width / bar.spoke.length;
  c.fillStyle = colour("grid");
  c.fillRect(0, height - 1, width, 1);
  c.fillStyle = colour("recorded");
  bar.spoke.forEach((n, nth) => {
    if (!n) return;
    c.globalAlpha = 0.35 + 0.65 * n / most;
    c.fillRect(nth * wide, 2, wide + 0.2, height - 3);
  });
}
function drawSpokes() {
  for (const bar of document.querySelectorAll(".spoke")) if (bar.clientWidth) drawSpoke(bar);
}
function showTopics(host, reply, plot) {
  const left = reply.topics_total - reply.topics.length;
  refill(host, ...listing(reply.topics.map((each) => topicRow(each, plot)), MOST_ROWS),
    ...(left ? [soft(`${left} more topics are not listed.`)] : []));
  const rest = host.querySelector(":scope > details");
  if (rest) rest.addEventListener("toggle", drawSpokes);
  drawSpokes();
}

/* Which topics can place the robot: offered where there are several, or where none is named. */
function offerPoses(reply, view, chosen) {
  const options = reply.places_robot.map(({ topic, kind }) => [topic, kind === "fixes" ? `${topic} (GPS)` : topic]);
  if (chosen && !options.some(([topic]) => topic === chosen)) options.push([chosen, chosen]);
  const none = view.no_path ? "choose a topic" : "as configured";
  at("poses-part").hidden = !chosen && options.length < (view.no_path ? 1 : 2);
  if (document.activeElement !== at("poses")) {
    at("poses").replaceChildren(...[["", none], ...options].map(
      ([value, text]) => el("option", { value }, text)));
  }
  at("poses").value = chosen;
}
