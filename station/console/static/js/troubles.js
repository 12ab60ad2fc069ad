// What is wrong with the booth, as `station status` says it, with the page's buttons for its commands.

import { h } from './dom.js';
import { t } from './i18n.js';
import { withViews as said } from './remedies.js';

const HAND_OVER = /^deliver /;

// One sentence for each trouble, in the reader's language; one for all hand-overs, which are not in
// the way of scans.
export function troubles(state) {
  if (!state.running) return [t('booth.notRunning', { fault: said(state.fault) })];
  const remarks = state.remarks.map(said);
  if (state.problems.length) {
    const [late, ...others] = state.problems.filter((problem) => HAND_OVER.test(problem));
    const told = state.problems.filter((problem) => !HAND_OVER.test(problem)).map(said);
    const more = others.length ? ` (${t('booth.moreWaiting', { n: others.length })})` : '';
    return [...told, ...remarks, ...(late ? [said(late) + more] : [])];
  }
  return state.disk_free_mb < 1.5 * state.disk_needed_mb ? [t('booth.diskLow'), ...remarks] : remarks;
}

// A banner and the function that shows in it what is wrong now.
export function troubleBanner() {
  const banner = h('div', { className: 'banner', id: 'troubles', role: 'alert', hidden: true });
  let told = null;
  function show(state) {
    const sentences = troubles(state);
    const now = JSON.stringify([state.can_scan, sentences]);
    // Written anew only when it changes: a reader of the screen says it each time.
    if (now === told) return;
    told = now;
    banner.hidden = !sentences.length;
    banner.className = `banner ${state.can_scan ? 'warn' : 'bad'}`;
    banner.replaceChildren(...sentences.map((sentence) => h('div', {}, sentence)));
  }
  return [banner, show];
}
