// Uploads one file by tus-js-client, as a page or a script would: node tus-upload.mjs ENDPOINT DATASET FILE NAME MODE
// MODE: plain; chunks (64 KiB each); parallel (three connections, put together at the end).
// Ends with 0 once the server has everything, and prints how often it had to go on.
import { createReadStream } from "node:fs";
import { Upload } from "tus-js-client";

const [endpoint, dataset, file, name, mode] = process.argv.slice(2);
let retries = 0;
const options = {
  endpoint,
  metadata: { dataset, path: name },
  retryDelays: Array(100).fill(20),
  onShouldRetry: () => (retries += 1) > 0,
  onError: (error) => {
    console.error(String(error));
    process.exit(1);
  },
  onSuccess: () => {
    console.log(`went on ${retries} times`);
    process.exit(0);
  },
};
if (mode === "plain") Object.assign(options, { chunkSize: Infinity });
if (mode === "chunks") Object.assign(options, { chunkSize: 64 << 10, uploadDataDuringCreation: true });
if (mode === "parallel") Object.assign(options, { parallelUploads: 3 });
new Upload(createReadStream(file), options).start();
