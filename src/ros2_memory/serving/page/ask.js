/* The form that asks any tool that only reads. */

let tools = [];
let latest = null;

/* The page only reads: a tool that writes is not offered. */
function offer(all) {
  tools = all.filter((each) => !(each.annotations && each.annotations.readOnlyHint === false));
  at("tool").replaceChildren(...tools.map((each) => el("option", { value: each.name }, each.name)));
  fields();
}
const chosen = () => tools.find((each) => each.name === at("tool").value);
const FIRST = { seconds_ago: () => 10, seconds: () => 60, start: () => latest - 60,
  end: () => latest, timestamp: () => latest - 10 };
const TIMES = /^(timestamp|before|(with_)?(start|end))$/;

function control(name, schema, required) {
  const id = "field-" + name;
  const options = schema.enum || (schema.type === "boolean" ? ["true", "false"] : null);
  let input;
  if (options) {
    const none = required ? [] : [el("option", { value: "" }, "(unset)")];
    input = el("select", { id, name }, ...none, ...options.map((each) => el("option", { value: each }, each)));
  } else {
    input = el("input", { id, name, type: "text", spellcheck: "false", autocapitalize: "none" });
    if (schema.type === "number" || schema.type === "integer") {
      input.type = "number";
      input.step = schema.type === "integer" ? "1" : "any";
      if (schema.minimum !== undefined) input.min = schema.minimum;
      if (schema.maximum !== undefined) input.max = schema.maximum;
    }
    if (/topic/.test(name)) input.setAttribute("list", "known");
    if ((required || name === "timestamp") && FIRST[name] && latest !== null) input.value = Math.round(FIRST[name]() * 1000) / 1000;
    if (schema.default !== undefined) input.placeholder = String(schema.default);
  }
  if (required) input.required = true;
  const about = el("span", { class: "soft", id: id + "-about" });
  const describe = () => {
    const asTime = TIMES.test(name) && input.value !== "" && isTime(Number(input.value))
      ? ` ${clock(Number(input.value))}` : "";
    about.textContent = plain((schema.description || "") + asTime
      + (schema.type === "array" ? " Separated by commas." : ""));
  };
  describe();
  input.addEventListener("input", describe);
  input.setAttribute("aria-describedby", about.id);
  return el("div", {}, el("label", { for: id }, name, required ? "" : el("span", { class: "soft" }, " optional")),
    input, about);
}
function fields() {
  const tool = chosen();
  if (!tool) return;
  at("about").textContent = plain(tool.description || "");
  const required = tool.inputSchema.required || [];
  at("fields").replaceChildren(...Object.entries(tool.inputSchema.properties || {}).map(
    ([name, schema]) => control(name, schema, required.includes(name))));
}
function given(schema, text) {
  if (schema.type === "number" || schema.type === "integer") return Number(text);
  if (schema.type === "boolean") return text === "true";
  if (schema.type === "array") return text.split(",").map((each) => each.trim()).filter(Boolean);
  if (schema.type === "string" || schema.enum) return text;
  try {
    const read = exactly(text);
    return read === null || Array.isArray(read) ? text : read;
  } catch {
    return text;
  }
}
at("question").addEventListener("submit", async (event) => {
  event.preventDefault();
  const tool = chosen();
  if (!tool) return;
  const asked = {};
  for (const [name, schema] of Object.entries(tool.inputSchema.properties || {})) {
    const text = at("field-" + name).value;
    if (text !== "") asked[name] = given(schema, text);
  }
  at("exchange").hidden = false;
  at("asked").textContent = plain(`${tool.name} ${JSON.stringify(asked, null, 1)}`);
  at("told").textContent = "";
  at("outcome").textContent = "is awaited";
  at("outcome").className = "";
  at("send").disabled = true;
  const begun = performance.now();
  try {
    const reply = state.recording ? await fetched(`/page/moment?${new URLSearchParams({
      recording: state.recording, tool: tool.name, arguments: JSON.stringify(asked) })}`, {}, exactly)
      : await call(tool.name, asked);
    const refused = Boolean(reply && reply.error);
    at("told").textContent = plain(JSON.stringify(reply, null, 2));
    at("outcome").textContent = (refused ? "no answer" : "answered")
      + ` in ${Math.round(performance.now() - begun)} ms`;
    at("outcome").className = refused ? "warn" : "good";
  } catch (error) {
    at("told").textContent = plain(error.message);
    at("outcome").textContent = "failed";
    at("outcome").className = "bad";
  } finally {
    at("send").disabled = false;
    at("send").focus();
  }
});
at("tool").addEventListener("change", fields);
at("ask-part").addEventListener("toggle", async () => {
  if (tools.length || !at("ask-part").open) return;
  try {
    const topics = await call("list_recorded_topics");
    if (!topics.error) {
      at("known").replaceChildren(...topics.map((each) => el("option", { value: each.topic })));
    }
    offer((await rpc("tools/list", {})).tools);
  } catch (error) {
    at("about").textContent = plain(error.message);
  }
});
