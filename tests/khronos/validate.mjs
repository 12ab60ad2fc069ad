// Prints the Khronos validator's report on a GLB file as JSON.
import { readFileSync } from "node:fs";
import { validateBytes } from "gltf-validator";

const bytes = new Uint8Array(readFileSync(process.argv[2]));
console.log(JSON.stringify(await validateBytes(bytes, { format: "glb", maxIssues: 100 })));
