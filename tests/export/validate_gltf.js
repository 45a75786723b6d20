// Prints the report of the Khronos validator on a file; exit code 3 where it is not installed.
let validator;
try {
  validator = require(process.env.GLTF_VALIDATOR || "gltf-validator");
} catch {
  process.exit(3);
}
const data = new Uint8Array(require("fs").readFileSync(process.argv[2]));
validator.validateBytes(data).then((report) => console.log(JSON.stringify(report)));
