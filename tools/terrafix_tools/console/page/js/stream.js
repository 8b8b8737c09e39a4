// The event stream of a flight. It reads with fetch, not EventSource: that shows the comments which the service sends
// into silence, so that a connection that is dead but open is noticed too, and it lets Last-Event-ID be sent by us.

const SILENT_MS = 20000; // a comment comes after 15 s
const RETRY_MS = [500, 1000, 2000, 4000]; // the last one again and again

/** Splits a text stream into events: feed(text) calls onEvent({id, name, data}) for each that is complete. */
export function parser(onEvent) {
  let rest = "";
  let event = {id: null, name: "message", data: []};
  const line = (text) => {
    if (text === "") {
      if (event.data.length) onEvent({id: event.id, name: event.name, data: JSON.parse(event.data.join("\n"))});
      event = {id: null, name: "message", data: []};
      return;
    }
    const colon = text.indexOf(":");
    if (colon === 0) return; // a comment
    const field = colon < 0 ? text : text.slice(0, colon);
    const value = colon < 0 ? "" : text.slice(colon + 1).replace(/^ /, "");
    if (field === "id") event.id = Number(value);
    else if (field === "event") event.name = value;
    else if (field === "data") event.data.push(value);
  };
  return (text) => {
    const lines = (rest + text).split(/\r?\n/);
    rest = lines.pop();
    lines.forEach(line);
  };
}

export class EventStream {
  /** onEvent({id, name, data}); onState("live" | "lost", problem status or 0). */
  constructor(flightId, after, onEvent, onState) {
    this.flightId = flightId;
    this.lastId = after;
    this.onEvent = onEvent;
    this.onState = onState;
    this.closed = false;
    this.run();
  }

  close() {
    this.closed = true;
    this.abort?.abort();
    this.wake?.();
  }

  async run() {
    let attempt = 0;
    while (!this.closed) {
      let status = 0;
      try {
        status = await this.read(() => { attempt = 0; });
      } catch { /* cut off */ }
      if (this.closed) return;
      this.onState("lost", status);
      if (status === 404) return; // the flight was deleted
      const wait = RETRY_MS[Math.min(attempt++, RETRY_MS.length - 1)];
      await new Promise((resolve) => { this.wake = resolve; setTimeout(resolve, wait); });
    }
  }

  /** Until the stream ends or is silent for too long. -> status of a refusal, 0: none. */
  async read(begun) {
    this.abort = new AbortController();
    let timer = 0;
    const alive = () => {
      clearTimeout(timer);
      timer = setTimeout(() => this.abort.abort(), SILENT_MS);
    };
    alive();
    try {
      const response = await fetch(`/flights/${this.flightId}/events`, {
        credentials: "same-origin",
        cache: "no-store",
        headers: {"Last-Event-ID": String(this.lastId)},
        signal: this.abort.signal,
      });
      if (!response.ok) return response.status;
      begun();
      this.onState("live", 0);
      const feed = parser((event) => {
        if (event.id !== null) {
          if (event.id <= this.lastId) return;
          this.lastId = event.id;
        }
        this.onEvent(event);
      });
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      for (;;) {
        const {value, done} = await reader.read();
        if (done) return 0;
        alive();
        feed(value);
      }
    } finally {
      clearTimeout(timer);
    }
  }
}
