// Compiles WGSL files with Tint, the compiler of Chrome, and prints the name and the errors of each that it refuses.
// Usage: node tint.mjs FOLDER_OF_WEBGPU FILE...
import { createRequire } from 'node:module';
import { readFileSync } from 'node:fs';

const [modules, ...files] = process.argv.slice(2);
const { create, globals } = createRequire(`${modules}/x`)('webgpu');
Object.assign(globalThis, globals);
// The instance must outlive its devices, so the garbage collector must not take it.
globalThis.gpu = create(['backend=null']);
const adapter = await gpu.requestAdapter();
if (!adapter) {
  console.log('no adapter');
  process.exit(2);
}
const subgroups = adapter.features.has('subgroups') ? ['subgroups'] : [];
const device = await adapter.requestDevice({ requiredFeatures: subgroups });
for (const file of files) {
  device.pushErrorScope('validation');
  const module = device.createShaderModule({ code: readFileSync(file, 'utf8') });
  const errors = (await module.getCompilationInfo()).messages.filter((message) => message.type === 'error');
  await device.popErrorScope();
  for (const { lineNum, message } of errors) console.log(`${file}:${lineNum}: ${message}`);
}
device.destroy();
