// Reads a glb with gltf-transform and checks it with Khronos's validator: node read_glb.mjs FILE.glb OUTPUT.json
import { readFileSync, writeFileSync } from "node:fs";
import { Logger, NodeIO, Verbosity } from "@gltf-transform/core";
import validator from "gltf-validator";

const [input, output] = process.argv.slice(2);
const bytes = new Uint8Array(readFileSync(input));
const document = await new NodeIO().setLogger(new Logger(Verbosity.ERROR)).readBinary(bytes);
const node = document.getRoot().listNodes()[0];
const primitive = node.getMesh().listPrimitives()[0];
const attributes = {};
for (const semantic of primitive.listSemantics()) {
  const accessor = primitive.getAttribute(semantic);
  const values = Array.from({ length: accessor.getCount() }, (_, i) => accessor.getElement(i, []));
  attributes[semantic] = values;
}
const { issues } = await validator.validateBytes(bytes, { maxIssues: 1000 });
const report = { attributes, mode: primitive.getMode(), rotation: node.getRotation(), issues: issues.messages };
writeFileSync(output, JSON.stringify(report));
