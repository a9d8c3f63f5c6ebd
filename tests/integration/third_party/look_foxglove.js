// A viewer of a Foxglove server that is not Foxglove: npm's @foxglove/ws-protocol, which reads the server's messages, and
// protobufjs, which decodes them by nothing but the schemas that the server sends. It subscribes to all topics, or to
// those given, until each of the wanted ones has come, and prints what it saw as JSON.
"use strict";
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const protobuf = require("protobufjs");
const { FileDescriptorSet } = require("protobufjs/ext/descriptor");
const WebSocket = require("ws");

const order = JSON.parse(process.argv[2]);
// Version 0.8.0 has the name of an older subprotocol; its messages are the same.
const ws = new WebSocket(order.url, ["foxglove.sdk.v1"]);
const client = new FoxgloveClient({ ws });
const channels = new Map();
const seen = { topics: {}, status: [], parameters: {}, answers: {}, errors: [], announced: [] };

function decoder(channel) {
  if (channel.encoding === "json") return (bytes) => JSON.parse(Buffer.from(bytes).toString());
  const root = protobuf.Root.fromDescriptor(FileDescriptorSet.decode(Buffer.from(channel.schema, "base64")));
  const type = root.lookupType(channel.schemaName);
  return (bytes) => {
    const found = type.toObject(type.decode(bytes), { longs: Number, enums: String, bytes: String });
    return typeof found.data === "string" ? { ...found, data: found.data.slice(0, 88) } : found;
  };
}

let finished = false;
function finish() {
  if (finished) return;
  finished = true;
  console.log(JSON.stringify(seen));
  client.close();
  setTimeout(() => process.exit(0), 200).unref();
}

function look() {
  const come = order.wanted.every((topic) => topic in seen.topics);
  if (come && (!order.set || "set" in seen.answers)) finish();
}

setTimeout(finish, order.timeout_s * 1000).unref();
client.on("error", (error) => seen.errors.push(String(error)));
client.on("status", (status) => seen.status.push(status.message));
client.on("serverInfo", (info) => {
  seen.server = info;
  client.getParameters([], "get");
  if (order.set) client.setParameters([order.set], "set");
});
client.on("parameterValues", (message) => {
  for (const each of message.parameters) seen.parameters[each.name] = each.value;
  if (message.id) seen.answers[message.id] = message.parameters;
  look();
});
client.on("advertise", (list) => {
  for (const channel of list) {
    seen.announced.push(channel.topic);
    if (!order.topics || order.topics.includes(channel.topic)) {
      channels.set(client.subscribe(channel.id), { ...channel, decode: decoder(channel) });
    }
  }
});
client.on("message", (message) => {
  const channel = channels.get(message.subscriptionId);
  const bytes = new Uint8Array(message.data.buffer, message.data.byteOffset, message.data.byteLength);
  try {
    const decoded = channel.decode(bytes);
    const topic = (seen.topics[channel.topic] ??= { count: 0, first: decoded, schema: channel.schemaName });
    topic.count += 1;
  } catch (error) {
    seen.errors.push(`${channel.topic}: ${error}`);
  }
  look();
});
