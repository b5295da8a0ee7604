// The part of tus-js-client that the page uses: resumable uploads.
export { Upload } from "tus-js-client";
