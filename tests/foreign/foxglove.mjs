// Checks an export for Foxglove against Foxglove's JSON schemas: decodes each message by the schema that the file has
// (a protobuf descriptor), and prints by schema how many messages were checked and what was wrong with the first bad one.
import { McapIndexedReader } from "@mcap/core";
import * as schemas from "@foxglove/schemas/jsonschema.js";
import Ajv from "ajv";
import { decompress } from "fzstd";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor.js";
import { open } from "node:fs/promises";

const file = await open(process.argv[2]);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, size) => {
    const buffer = new Uint8Array(Number(size));
    await file.read(buffer, 0, Number(size), Number(offset));
    return buffer;
  },
};
const decompressHandlers = { zstd: (packed, size) => decompress(packed, new Uint8Array(Number(size))) };
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const ajv = new Ajv({ strict: false, logger: false });
const OPTIONS = { longs: Number, enums: Number, bytes: String, arrays: true, defaults: true };

function snake(name) {
  return name.replace(/(?<=[a-z])[A-Z]/g, (letter) => "_" + letter.toLowerCase());
}

// Foxglove's JSON schemas have times as {sec, nsec}, protobuf as {seconds, nanos}; an absent message is no property.
function plain(value) {
  if (Array.isArray(value)) return value.map(plain);
  if (value === null || typeof value !== "object") return value;
  if ("nanos" in value) return { sec: value.seconds, nsec: value.nanos };
  const present = Object.entries(value).filter(([, item]) => item !== null);
  return Object.fromEntries(present.map(([name, item]) => [snake(name), plain(item)]));
}

const kinds = new Map();
function kindOf(schema) {
  if (!kinds.has(schema.id)) {
    const name = schema.name.slice("foxglove.".length);
    const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
    kinds.set(schema.id, { type: root.lookupType(schema.name), check: schemas[name] && ajv.compile(schemas[name]) });
  }
  return kinds.get(schema.id);
}

const found = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  if (!schema?.name.startsWith("foxglove.")) continue;
  const { type, check } = kindOf(schema);
  const told = (found[schema.name] ??= { messages: 0, problem: check ? "" : "Foxglove knows no schema of this name" });
  told.messages += 1;
  const value = plain(type.toObject(type.decode(message.data), OPTIONS));
  if (check && !told.problem && !check(value)) told.problem = `${channel.topic}: ${ajv.errorsText(check.errors)}`;
}
await file.close();
process.stdout.write(JSON.stringify(found));
