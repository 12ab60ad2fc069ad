// The console's events, resumed by the browser itself after a loss (Last-Event-ID).

import { address } from './api.js';

const KINDS = ['camera', 'framesets', 'scan', 'job', 'result', 'fault', 'calibration', 'delivery', 'reset'];
const listeners = new Set();
let source = null;
let lost = false;
let again = null;

// Calls `heard(kind, data)` until the returned function is called. Kinds beside the console's own:
// "lost" and "back" tell of the connection.
export function listen(heard) {
  listeners.add(heard);
  return () => listeners.delete(heard);
}

export const isLost = () => lost;

function tell(kind, data) { for (const heard of [...listeners]) heard(kind, data); }

export function connect() {
  if (source) return;
  source = new EventSource(address('/events'));
  for (const kind of KINDS) source.addEventListener(kind, (event) => tell(kind, JSON.parse(event.data)));
  source.onopen = () => { if (lost) { lost = false; tell('back', {}); } };
  source.onerror = () => {
    if (!lost) { lost = true; tell('lost', {}); }
    if (source.readyState === EventSource.CLOSED) {
      source = null;
      again = setTimeout(connect, 1000);
    }
  };
}

export function disconnect() {
  // Else whoever has to log in first is refused once a second.
  clearTimeout(again);
  if (source) source.close();
  source = null;
}
