// The official TypeScript client: handshake, list of tools, one answer, one refusal.
// Arguments: sse or http, the URL, and a token to show where there is one.
import { Client } from "@modelcontextprotocol/sdk/client/index.js";
import { SSEClientTransport } from "@modelcontextprotocol/sdk/client/sse.js";
import { StreamableHTTPClientTransport } from "@modelcontextprotocol/sdk/client/streamableHttp.js";

const [kind, url, token] = process.argv.slice(2);
const headers = token ? { Authorization: `Bearer ${token}` } : {};
const Transport = kind === "sse" ? SSEClientTransport : StreamableHTTPClientTransport;
const client = new Client({ name: "conformance", version: "1" });
await client.connect(new Transport(new URL(url), { requestInit: { headers } }));
const { tools } = await client.listTools();
const answer = await client.callTool({ name: "data_time_range", arguments: {} });
const refusal = await client.callTool({ name: "get_position_at", arguments: { timestamp: "x" } });
await client.ping();
await client.close();
console.log(
  JSON.stringify({
    server: client.getServerVersion().name,
    tools: tools.length,
    answer: { isError: answer.isError ?? false, ...JSON.parse(answer.content[0].text) },
    refusal: { isError: refusal.isError ?? false, ...JSON.parse(refusal.content[0].text) },
  }),
);
