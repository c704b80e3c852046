// An upload in parts (tus 1.0) that can be paused, and continues after a lost connection or when
// the same file is chosen again.
const HOME = "/api/v1/uploads";
const PART = 4 << 20; // [bytes]
const PAUSES = [1, 2, 4, 8, 16]; // [s] before each new attempt at a part
const TUS = { "Tus-Resumable": "1.0.0" };

export const isWorthParts = (file) => file.size > PART;

const base64 = (text) => btoa(String.fromCharCode(...new TextEncoder().encode(text)));
const wait = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));

export class Resumable {
  constructor(file, about, progress) {
    Object.assign(this, { file, about, progress, offset: 0, resume: null, abort: null });
    const pairs = [...about].map(([key, value]) => `${key} ${base64(value)}`);
    this.metadata = pairs.join(",");
    this.key = `upload ${file.size} ${file.lastModified} ${this.metadata}`;
  }

  get isPaused() {
    return this.resume !== null;
  }

  // Stops after the bytes that are here, or goes on.
  toggle() {
    if (this.isPaused) {
      this.resume();
      this.resume = null;
    } else {
      this.held = new Promise((resolve) => { this.resume = resolve; });
      this.abort?.abort();
    }
  }

  // Sends the file; returns the response to its last part, or to what was refused.
  async run() {
    this.address = localStorage.getItem(this.key);
    const found = this.address && (await this.head());
    if (!found) {
      const refused = await this.create();
      if (refused) return refused;
    }
    for (;;) {
      if (this.isPaused) await this.held;
      const answer = await this.part();
      if (!answer) continue;
      if (!answer.ok || this.offset >= this.file.size) {
        localStorage.removeItem(this.key);
        return answer;
      }
    }
  }

  async create() {
    const headers = { ...TUS, "Upload-Length": this.file.size, "Upload-Metadata": this.metadata };
    const answer = await fetch(HOME, { method: "POST", headers });
    if (!answer.ok) return answer;
    this.address = answer.headers.get("Location");
    this.offset = 0;
    localStorage.setItem(this.key, this.address);
    return null;
  }

  // Reads how many bytes are here; false if the service does not know the upload any more.
  async head() {
    const answer = await fetch(this.address, { method: "HEAD", headers: TUS });
    if (!answer.ok) return false;
    this.offset = Number(answer.headers.get("Upload-Offset"));
    this.progress(this.offset);
    return true;
  }

  // Sends one part; null where it is to be sent again.
  async part() {
    for (const pause of [0, ...PAUSES]) {
      await wait(pause);
      this.abort = new AbortController();
      const headers = {
        ...TUS,
        "Content-Type": "application/offset+octet-stream",
        "Upload-Offset": this.offset,
      };
      const body = this.file.slice(this.offset, this.offset + PART);
      try {
        const { signal } = this.abort;
        const answer = await fetch(this.address, { method: "PATCH", headers, body, signal });
        if (answer.status !== 409 && answer.status !== 423) {
          if (answer.ok) this.offset = Number(answer.headers.get("Upload-Offset"));
          this.progress(this.offset);
          return answer;
        }
      } catch (error) {
        if (this.isPaused) await this.held;
        else if (pause === PAUSES.at(-1)) throw error;
      }
      if (!(await this.head().catch(() => true))) {
        const refused = await this.create();
        if (refused) return refused;
      }
    }
    throw new Error("The service does not take the upload.");
  }
}
