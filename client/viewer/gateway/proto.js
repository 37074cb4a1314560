// The interface files, read with protobufjs. Paths are resolved against one folder, as protoc does with -I.
import fs from 'node:fs';
import path from 'node:path';
import { fileURLToPath } from 'node:url';
import protobuf from 'protobufjs';

export const defaultProtoFolder = fileURLToPath(new URL('../../../proto', import.meta.url));

const files = ['aureole/v1/simulation.proto', 'aureole/v1/input.proto'];

// Throws when a file is missing or cannot be parsed.
export function loadProto(folder = defaultProtoFolder) {
  for (const file of files) fs.accessSync(path.join(folder, file));
  const root = new protobuf.Root();
  // What is bundled with protobufjs keeps its name.
  root.resolvePath = (origin, target) =>
    target.startsWith('google/protobuf/') || path.isAbsolute(target) ? target : path.join(folder, target);
  root.loadSync(files, { keepCase: true });
  root.resolveAll();
  return root;
}
