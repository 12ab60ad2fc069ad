// Requests to the API; a problem document becomes an Error with its words.

import { t } from './i18n.js';
import { withViews as said } from './remedies.js';

const PREFIX = '/api/v1';

export class Problem extends Error {
  constructor(status, document) {
    super(said(document.detail || '') || document.title || `HTTP ${status}`);
    this.status = status;
    this.kind = (document.type || '').replace('/problems/', '');
  }
}

// What needs the console. Where it cannot be reached the browser's words are its own, and English.
export const reached = (promise) => promise.catch(() => { throw Object.assign(new Error(t('unreachable')), { kind: 'unreachable' }); });

export function address(path) { return PREFIX + path; }

export async function request(method, path, body, headers = {}) {
  const answer = await reached(fetch(PREFIX + path, {
    method,
    headers: body === undefined ? headers : { 'content-type': 'application/json', ...headers },
    body: body === undefined ? undefined : JSON.stringify(body),
    credentials: 'same-origin',
  }));
  if (!answer.ok) {
    const problem = await answer.json().catch(() => ({}));
    const error = new Problem(answer.status, problem);
    if (error.kind === 'not-logged-in') window.dispatchEvent(new Event('booth-login'));
    throw error;
  }
  return answer;
}

export const get = async (path) => reached((await request('GET', path)).json());
export const post = async (path, body, headers) => reached((await request('POST', path, body ?? {}, headers)).json());
export const remove = async (path) => reached((await request('DELETE', path)).json());
export const bytes = async (path) => reached((await request('GET', path)).arrayBuffer());

// A key for a request that begins something: the same press of a button never begins it twice.
export function freshKey() {
  const random = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(random, (byte) => byte.toString(16).padStart(2, '0')).join('');
}
