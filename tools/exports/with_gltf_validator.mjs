// Check the GLB file of an export with the Khronos glTF validator, as a stand-in for programs such as Unity.
//
//     npm install gltf-validator && node tools/exports/with_gltf_validator.mjs FOLDER
//
// The module is looked for from the working directory; tools/exports/make.py makes the folder.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const validator = createRequire(join(process.cwd(), "/"))("gltf-validator");
const file = join(process.argv[2], "export", "glb", "people.glb");
const report = await validator.validateBytes(new Uint8Array(readFileSync(file)));
const { numErrors, numWarnings, messages } = report.issues;
console.log(`${validator.version()}: ${numErrors} errors, ${numWarnings} warnings`);
for (const { pointer, message } of messages) console.log(`${pointer}: ${message}`);
console.log(`${report.info.totalVertexCount} vertices, ${report.info.animationCount} animation`);
process.exit(numErrors ? 1 : 0);
