// node run.js module.wasm pack: prints what the module finds in the pack.
const fs = require("fs");
const [wasm, pack] = process.argv.slice(2);
WebAssembly.instantiate(fs.readFileSync(wasm), {}).then(({ instance: { exports } }) => {
  const bytes = fs.readFileSync(pack);
  const at = exports.volpack_input(bytes.length);
  new Uint8Array(exports.memory.buffer, at, bytes.length).set(bytes);
  const length = exports.volpack_read();
  process.stdout.write(Buffer.from(exports.memory.buffer, exports.volpack_output(), length));
});
