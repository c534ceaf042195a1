// Changes of one output's level, as the host reads them.

import { EmulatorError } from './errors.mjs';

export const MAX_EDGES = 1 << 20;

export class Edges {
  /** `name`: of the output, for messages. */
  constructor(name) {
    this.name = name;
    this.clear();
  }

  clear() {
    this.flat = []; // nanoseconds and level, alternating
    this.lost = false;
  }

  add(nanos, level) {
    if (this.flat.length < 2 * MAX_EDGES) this.flat.push(Math.round(nanos), level ? 1 : 0);
    else this.lost = true;
  }

  /** Nanoseconds and level, alternating, since they were cleared. */
  read() {
    if (this.lost) throw new EmulatorError(`${this.name} had more than ${MAX_EDGES} edges: clear them more often`);
    return this.flat;
  }
}
