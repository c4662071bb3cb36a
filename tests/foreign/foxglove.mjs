// Checks an export for Foxglove against Foxglove's own schemas, and prints by schema how many messages were checked
// and what was wrong with the first that was.
import { McapIndexedReader } from "@mcap/core";
import * as schemas from "@foxglove/schemas/jsonschema.js";
import Ajv from "ajv";
import { decompress } from "fzstd";
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
const checks = new Map();
const found = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const name = reader.schemasById.get(channel.schemaId)?.name ?? "";
  if (!name.startsWith("foxglove.")) continue;
  if (!checks.has(name)) {
    const known = schemas[name.slice("foxglove.".length)];
    checks.set(name, known ? ajv.compile(known) : null);
  }
  const check = checks.get(name);
  const told = (found[name] ??= { messages: 0, problem: check ? "" : "Foxglove knows no schema of this name" });
  told.messages += 1;
  if (check && !told.problem && !check(JSON.parse(new TextDecoder().decode(message.data))))
    told.problem = `${channel.topic}: ${ajv.errorsText(check.errors)}`;
}
await file.close();
process.stdout.write(JSON.stringify(found));
