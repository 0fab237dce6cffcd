/* What the page asks of the server: its own two addresses, and tools over /mcp. */

const TOKEN = "ros2-memory.token";
let token = sessionStorage.getItem(TOKEN) || "";

class Locked extends Error {}

/* Reads JSON. A whole number of more digits than a number of JavaScript has stays as it is written. */
function exactly(text) {
  return JSON.parse(text, (_, value, written) => (JSON.rawJSON && Number.isInteger(value)
    && !Number.isSafeInteger(value) ? JSON.rawJSON(written.source) : value));
}
async function fetched(path, given = {}, read = JSON.parse) {
  const headers = { ...given.headers };
  if (token) headers.Authorization = "Bearer " + token;
  const response = await fetch(path, { ...given, headers, cache: "no-store", credentials: "omit" }).catch((error) => {
    throw error.name === "AbortError" ? error : new Error("The server does not answer.");
  });
  if (response.status === 401) throw new Locked(await response.text());
  if (!response.ok) throw new Error(`${response.status}: ${await response.text()}`);
  return read(await response.text());
}

/* Returns an answer of one of the page's own addresses; one that says why there is none is thrown. */
async function asked(path, query, signal) {
  const reply = await fetched(`${path}?${new URLSearchParams(query)}`, { signal });
  if (reply.error) throw new Error(reply.detail || reply.error);
  return reply;
}

async function rpc(method, params) {
  const reply = await fetched("/mcp", { method: "POST",
    headers: { "Content-Type": "application/json",
      "Accept": "application/json, text/event-stream" },
    body: JSON.stringify({ jsonrpc: "2.0", id: 1, method, params }) });
  if (reply.error) throw new Error(reply.error.message);
  return reply.result;
}
async function call(name, given = {}) {
  const result = await rpc("tools/call", { name, arguments: given });
  return exactly(result.content[0].text);
}
function keepToken(given) {
  token = given;
  sessionStorage.setItem(TOKEN, given);
}
