// What is known of one flight: its results by frame, and what its events add.

const KEPT_LINES = 500; // of the verdicts and of the log

export class FlightModel {
  constructor(flight, results) {
    this.flight = flight;
    this.results = new Map();
    this.newest = null; // result of the newest frame
    this.newestFix = null; // newest result with a position
    this.lastMatch = null; // newest result that rests on a map match of its own frame
    this.verdicts = [];
    this.log = [];
    this.request = flight.request ? {...flight.request, candidate_tiles: []} : null;
    this.facts = null; // of a live flight
    this.factsAt = 0; // ms
    this.statistics = null;
    this.progress = null; // of the solution of the whole flight
    this.known = flight.last_event_id; // events up to this one happened before the page was opened, nobody knows when
    this.openedAt = Date.now();
    this.updatedAt = null; // ms: when the newest result came; null: before the page was opened
    this.connection = "connecting"; // "live", "lost"
    this.lostAt = 0;
    for (const result of results) this.take(result);
  }

  get isLive() {
    return this.flight.kind === "live";
  }

  get ordered() {
    return [...this.results.values()];
  }

  take(result) {
    this.results.set(result.frame_id, result);
    if (!this.newest || result.frame_id >= this.newest.frame_id) this.newest = result;
    if (result.gps && (!this.newestFix || result.frame_id >= this.newestFix.frame_id)) this.newestFix = result;
    if (result.source === "satellite_anchored" && (!this.lastMatch || result.frame_id >= this.lastMatch.frame_id)) {
      this.lastMatch = result;
    }
  }

  /** Flight time since the newest map match [s]; null: there was none. */
  get sinceMatch_s() {
    return this.lastMatch && this.newest ? this.newest.t_s - this.lastMatch.t_s : null;
  }

  /** -> whether the flight itself should be read again: its counts and fragments are in no event. */
  apply({id, name, data}) {
    const at = id !== null && id <= this.known ? null : Date.now();
    switch (name) {
      case "frame_processed":
        // An old event that is sent again must not undo a refined position.
        if (!this.results.get(data.frame_id)?.refined) this.take(data);
        this.updatedAt = at ?? this.updatedAt;
        return true;
      case "frame_refined": {
        const before = this.results.get(data.frame_id);
        if (before) {
          const {gps, altitude, ellipse, orientation, covariance, m_per_unit, source} = data;
          this.take({...before, gps, altitude, ellipse, orientation, covariance, m_per_unit, refined: true, refined_by: source});
        }
        return false;
      }
      case "verdict_given":
        keep(this.verdicts, data);
        return false;
      case "health":
        this.facts = data.facts;
        this.factsAt = Date.now();
        return false;
      case "user_input_needed":
        this.request = data;
        break;
      case "state_changed":
        this.flight.state = data.state;
        if (data.state === "processing" || data.state === "completed") this.request = null;
        break;
      case "finalise_progress":
        this.progress = data;
        break;
      case "flight_completed":
        this.statistics = data.statistics;
        break;
    }
    keep(this.log, {name, data, at});
    return true;
  }

  refresh(flight) {
    this.flight = flight;
    if (!flight.request) this.request = null;
    else if (this.request?.request_id !== flight.request.request_id) {
      this.request = {...flight.request, candidate_tiles: []};
    }
  }
}

function keep(lines, line) {
  lines.push(line);
  if (lines.length > KEPT_LINES) lines.shift();
}
