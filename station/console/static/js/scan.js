// Taking a scan: one label, one button.

import { freshKey, get, post } from './api.js';
import { Cameras } from './cameras.js';
import { h, notice, s } from './dom.js';
import { isLost, listen } from './events.js';
import { bodyFigure } from './figure.js';
import { outcome, t, time } from './i18n.js';
import { withViews as said } from './remedies.js';
import { troubleBanner } from './troubles.js';

const AROUND = 2 * Math.PI * 108;
const FINAL = ['delivered', 'rescan', 'failed'];
const POLL_MS = 1000;
const TROUBLES_MS = 5000;
const TOGETHER_MS = 250;

// What the view told when it was left: it is told on where it is drawn again in another language,
// and wherever the scan is not over.
let kept = null;
const underway = ({ asking, current }) => asking !== null || (current !== null && !FINAL.includes(current.state));

// The scan that is under way outlives the page, in its window: a page that was loaded anew asked for
// the next one, without a word of the person in the booth.
const UNDERWAY = 'booth.scan';
function remember(scan) {
  try {
    if (scan) sessionStorage.setItem(UNDERWAY, scan.scan_id);
    else sessionStorage.removeItem(UNDERWAY);
  } catch { /* a browser that keeps nothing */ }
}

async function remembered() {
  let scanId = null;
  try { scanId = sessionStorage.getItem(UNDERWAY); } catch { /* as above */ }
  if (!scanId) return null;
  const current = await get(`/scans/${scanId}`).catch((error) => {
    // Anything else may be over when the view is opened again.
    if (error.kind === 'no-such-scan') remember(null);
  });
  return current && { label: current.label, pressed: null, took: null, current, asking: null };
}

// Of a countdown that is over, nothing but what is heard meanwhile tells the view that is opened again.
listen((kind, data) => {
  const scan = kept?.current;
  if (kind === 'scan' && scan?.scan_id === data.scan_id && !FINAL.includes(data.state)) scan.state = data.state;
});

export async function scan(main, session) {
  // Nobody knows how long a scan took whose end was awaited in another view.
  if (kept && !session.again) kept = underway(kept) ? { ...kept, pressed: null } : null;
  kept ??= await remembered();
  const state = await get('/booth');
  const front = state.cameras.map((camera) => camera.name).filter((name) => name.startsWith('front'));
  const shown = front.length ? front : state.cameras.slice(0, 2).map((camera) => camera.name);
  const cameras = new Cameras(shown, 'stack mini');
  for (const camera of state.cameras) cameras.state(camera);
  const [banner, showTroubles] = troubleBanner();
  const presence = h('p', { className: 'soft', role: 'status' });
  cameras.onpresence = (somebody) => {
    const unseen = streaming ? 'scan.unseen' : 'booth.off';
    presence.textContent = t(somebody === null ? unseen : somebody ? 'scan.somebody' : 'scan.nobody');
  };
  const stage = h('section', { className: 'card stage', id: 'stage', 'aria-live': 'polite' });
  let streaming = state.streaming;
  let able = state.can_scan;
  let compiling = state.compiling;
  let asking = null;
  let label = '';
  let current = null;
  let pressed = null;
  let took = null;
  let timer = null;
  let parts = null;
  let closed = false;

  function ready() {
    current = null;
    clearInterval(timer);
    const input = h('input', { type: 'text', id: 'label', value: label, maxLength: session.label_length,
      placeholder: t('scan.placeholder'), autocomplete: 'off', enterKeyHint: 'go',
      onkeydown: (event) => { if (event.key === 'Enter') begin(); },
      oninput: () => { label = input.value; } });
    const help = streaming ? h('p', { className: 'soft' }, t('scan.ready'))
      : h('div', {}, h('p', {}, t('scan.needSensors')), h('button', { id: 'sensors', onclick: sensors }, t('booth.start')));
    stage.replaceChildren(
      h('div', { className: 'label' }, h('label', { htmlFor: 'label' }, t('scan.label')), input),
      h('button', { className: 'big primary', id: 'go', onclick: begin }, t('scan.go')), help);
    allow();
  }

  // A press that the booth would refuse is not offered; the banner says what is in the way.
  function allow() {
    for (const button of stage.querySelectorAll('#go, #again')) {
      button.disabled = closed || asking !== null || isLost() || !streaming || !able;
    }
  }

  async function sensors(event) {
    event.target.disabled = true;
    try {
      await post('/booth/start');
      streaming = true;
    } catch (error) { notice(error.message, true); }
    ready();
  }

  async function begin() {
    // The label's Enter comes here too.
    if (document.getElementById('go').disabled) return;
    pressed = performance.now();
    took = null;
    const body = { label: label.trim(), countdown_s: session.countdown_s };
    const answer = post('/scans', body, { 'Idempotency-Key': freshKey() });
    answer.catch((error) => notice(error.message, true));
    settle(answer);
  }

  // The view that asked for the scan may have been left before the booth answered.
  async function settle(answer) {
    asking = answer;
    allow();
    const found = await answer.catch(() => null);
    if (closed) return;
    asking = null;
    if (found) follow(found);
    else ready();
  }

  function follow(found) {
    current = found;
    remember(found);
    parts = null;
    clearInterval(timer);
    // Events tell sooner; asking now and then bridges a lost connection.
    if (FINAL.includes(current.state)) {
      // Refused at once, e.g. because a camera gives no frames: the reason is the verdict.
      finish();
      return;
    }
    timer = setInterval(ask, POLL_MS);
    show({ left_s: session.countdown_s });
  }

  // `unheard`: nothing was heard of it for a while. One that is not found was deleted then.
  async function ask({ unheard = false } = {}) {
    const mine = current;
    // A refusal may be the console's, which need not store it.
    if (!mine || mine.state === 'failed') return;
    try {
      const found = await get(`/scans/${mine.scan_id}`);
      if (current && found.scan_id === current.scan_id) take(found);
    } catch (error) {
      if (error.kind !== 'no-such-scan' || mine !== current || closed) return;
      // The countdown was the console's, which has been started again; anything else is asked again.
      if (mine.state === 'countdown') take({ state: 'failed', reasons: [], unbegun: true });
      else if (unheard) deleted();
    }
  }

  function deleted() {
    notice(t('scan.deleted'));
    remember(null);
    ready();
  }

  function take(found, more = {}) {
    if (!current || FINAL.includes(current.state)) return;
    const before = current.state;
    current = { ...current, ...found };
    // "accepted" may be late, or a failed job's, which is done again at once.
    if (before === 'reconstructing' && found.state === 'accepted') current.state = before;
    if (found.state !== 'countdown' || more.left_s !== undefined) show(more);
    if (FINAL.includes(current.state) && !FINAL.includes(before)) finish();
  }

  // Built once for a scan and then kept up to date: a button must not vanish under a finger.
  function taking() {
    const circle = { cx: 116, cy: 116, r: 108 };
    const done = s('circle', { ...circle, class: 'done', 'stroke-dasharray': AROUND, 'stroke-dashoffset': AROUND });
    const word = h('span', { className: 'word' });
    const ring = h('div', { className: 'ring' },
      s('svg', { viewBox: '0 0 232 232', 'aria-hidden': 'true' }, s('circle', circle), done), word);
    const leave = h('p', { className: 'leave', id: 'leave', hidden: true }, t('scan.leave'));
    const below = h('p');
    const give = h('button', { id: 'give-up', onclick: giveUp }, t('scan.give'));
    stage.replaceChildren(h('h2', {}, current.label || t('result.noLabel')), leave, ring, below, give);
    parts = { done, word, ring, leave, below, give };
  }

  function show({ left_s: left } = {}) {
    if (!parts) taking();
    const { done, word, ring, leave, below, give } = parts;
    const free = current.state === 'accepted' || current.state === 'reconstructing';
    const counting = current.state === 'countdown' || current.state === 'armed';
    const share = counting ? (left || 0) / Math.max(1, session.countdown_s)
      : free ? 0.3 : current.framesets / Math.max(1, current.wanted);
    // All pictures are taken: who asks is told "capturing" until they are stored.
    const taken = current.state === 'writing'
      || (current.state === 'capturing' && current.wanted > 0 && current.framesets >= current.wanted);
    const words = counting ? String(left || '…') : t(taken ? 'scan.storing'
      : { capturing: 'scan.hold', accepted: 'scan.waiting' }[current.state] || 'scan.working');
    done.setAttribute('stroke-dashoffset', AROUND * (1 - share));
    ring.classList.toggle('busy', free);
    word.className = counting ? 'number' : 'word';
    if (word.textContent !== words) word.textContent = words;
    leave.hidden = !free;
    const waits = compiling && current.state === 'reconstructing';
    below.hidden = !counting && !waits;
    below.textContent = t(waits ? 'scan.compiling' : 'scan.countdown');
    give.hidden = taken || current.state === 'reconstructing';
  }

  async function giveUp(event) {
    event.target.disabled = true;
    try { await post(`/scans/${current.scan_id}/cancel`); } catch (error) { notice(error.message, true); }
    ask();
  }

  // Marks the parts that the verdict doubts when they are known.
  async function mark(done, figure) {
    try {
      const quality = await get(`/scans/${done.scan_id}/quality`);
      const doubtful = quality.parts.filter((part) => part.doubtful).map((part) => part.name);
      figure.replaceWith(bodyFigure(doubtful));
    } catch { /* the verdict stands without it */ }
  }

  function finish() {
    clearInterval(timer);
    remember(null);
    const done = current;
    if (pressed !== null) took ??= ((performance.now() - pressed) / 1000).toFixed(1);
    const figure = bodyFigure();
    const cancelled = outcome(done) === 'cancelled';
    const look = { delivered: 'ok', rescan: 'rescan', failed: 'failed' }[done.state];
    const again = h('button', { id: 'again', className: look === 'ok' ? '' : 'primary', onclick: begin }, t('scan.again'));
    stage.replaceChildren(
      done.state === 'failed' ? '' : h('p', { className: 'leave', id: 'leave' }, t('scan.leave')),
      h('div', { className: `verdict ${look}`, id: 'verdict', 'data-verdict': look },
        figure,
        h('div', {}, h('h2', {}, t(`scan.${cancelled ? 'cancelled' : look}`)), h('p', {}, done.label || t('result.noLabel')),
          done.reasons.length && !cancelled ? h('ul', {}, done.reasons.map((reason) => h('li', {}, said(reason)))) : null,
          done.unbegun ? h('p', {}, t('scan.unbegun')) : null,
          done.state === 'failed' || took === null ? null : h('p', { className: 'small soft' }, t('scan.took', { n: took })))),
      h('div', { className: 'actions' },
        done.state === 'failed' || done.gone ? null : h('a', { className: `button ${look === 'ok' ? 'primary' : ''}`, id: 'open', href: `#/result/${done.scan_id}` }, t('scan.open')),
        again,
        h('button', { id: 'next', onclick: () => { label = ''; ready(); document.getElementById('label').focus(); } }, t('scan.next'))),
      h('button', { id: 'go', hidden: true }));
    allow();
    if (done.state !== 'failed') mark(done, figure);
    latest();
  }

  const list = h('div', { className: 'stack' });
  let listing = null;
  async function latest() {
    try {
      const { scans } = await get('/scans?limit=4');
      list.replaceChildren(...scans.map((one) => h('a', { className: 'small', href: `#/result/${one.scan_id}` },
        `${one.label || t('result.noLabel')} – ${t(`state.${outcome(one)}`)}, ${time(one.created)}`)));
    } catch { /* told elsewhere */ }
  }

  // All scans of a label may be deleted at once.
  function latestSoon() {
    clearTimeout(listing);
    listing = setTimeout(latest, TOGETHER_MS);
  }

  async function look() {
    try {
      const told = await get('/booth');
      showTroubles(told);
      able = told.can_scan;
      allow();
      compiling = told.compiling;
      if (current?.state === 'reconstructing') show();
    } catch { /* the connection's loss is told elsewhere */ }
  }

  const silence = listen((kind, data) => {
    if (kind === 'camera') cameras.state(data);
    if (['camera', 'fault', 'back'].includes(kind)) look();
    if (kind === 'lost') allow();
    if (kind === 'framesets' && data.streaming !== streaming) {
      streaming = data.streaming;
      if (!current) ready();
      else allow();
    }
    const over = kind === 'scan' && ['failed', 'deleted', 'taken'].includes(data.state);
    if (over || ['job', 'result', 'reset', 'back'].includes(kind)) latestSoon();
    if (kind === 'reset' || kind === 'back') ask({ unheard: true });
    if (!current || data.scan_id !== current.scan_id) return;
    if (kind === 'scan' && data.state === 'deleted') deleted();
    else if (kind === 'scan' && data.state === 'taken') {
      // The outcome stays, without its link.
      current = { ...current, gone: true };
      document.getElementById('open')?.remove();
    } else if (kind === 'scan') {
      const { state: next, framesets, wanted, reason } = data;
      take({ state: next, framesets, wanted, reasons: reason ? [reason] : [] }, { left_s: data.left_s });
    } else if (kind === 'job') take({ state: data.state });
    else if (kind === 'result') take({ state: data.state, reasons: data.reasons });
  });

  main.replaceChildren(
    h('div', { className: 'head' }, h('h1', {}, t('scan.title'))),
    banner,
    h('div', { className: 'scan' }, stage,
      h('aside', { className: 'stack', 'aria-label': t('scan.preview') }, cameras.element, presence,
        h('section', { className: 'card' }, h('h2', {}, t('scan.last')), list))));
  showTroubles(state);
  const looking = setInterval(look, TROUBLES_MS);
  const told = kept;
  kept = null;
  if (told) ({ label, pressed, took } = told);
  ready();
  if (told?.asking) settle(told.asking);
  else if (told?.current) {
    follow(told.current);
    ask({ unheard: true });
  }
  latest();
  return () => {
    closed = true;
    allow();
    kept = { label, pressed, took, current, asking };
    clearInterval(timer);
    clearInterval(looking);
    clearTimeout(listing);
    silence();
    cameras.close();
  };
}
