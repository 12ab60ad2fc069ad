// The screen in the booth: where to stand, the countdown, and when it is over.

import { get } from './api.js';
import { h, s } from './dom.js';
import { connect, listen } from './events.js';
import { loadWords, outcome, t } from './i18n.js';

const THANKS_MS = 12000;
const main = document.getElementById('person');
let timer = null;

function standing() {
  const skin = { fill: 'none', stroke: '#8fd0f0', 'stroke-width': 9, 'stroke-linecap': 'round', 'stroke-linejoin': 'round' };
  return s('svg', { viewBox: '0 0 260 420', role: 'img', 'aria-label': t('person.figure') },
    s('ellipse', { cx: 130, cy: 386, rx: 92, ry: 20, fill: 'none', stroke: '#f4b942', 'stroke-width': 5, 'stroke-dasharray': '12 9' }),
    s('path', { d: 'M130 412v-22m-12 11l12-11 12 11', ...skin, stroke: '#f4b942', 'stroke-width': 5, transform: 'rotate(180 130 401)' }),
    s('circle', { cx: 130, cy: 48, r: 27, ...skin }),
    s('path', { d: 'M104 92h52l-6 128h-40z', ...skin }),
    s('path', { d: 'M104 94L46 214M156 94l58 120', ...skin }),
    s('path', { d: 'M114 222l-16 154M146 222l16 154M98 376l-12 8M162 376l12 8', ...skin }),
    s('path', { d: 'M84 160c-8 6-14 14-20 24M176 160c8 6 14 14 20 24', stroke: '#f4b942', 'stroke-width': 3, fill: 'none', 'stroke-dasharray': '5 6' }));
}

function screen(look, ...content) {
  clearTimeout(timer);
  document.body.className = `person ${look}`;
  main.replaceChildren(...content);
}

function guide() {
  screen('', h('div', { className: 'guide' }, standing(),
    h('ol', {}, h('li', {}, t('person.stand')), h('li', {}, t('person.arms')), h('li', {}, t('person.look')))));
  document.body.dataset.screen = 'guide';
}

function countdown(left) {
  screen('', h('div', {}, h('div', { className: 'count' }, String(left)), h('div', { className: 'sub' }, t('person.soon'))));
  document.body.dataset.screen = 'countdown';
}

function hold() {
  screen('hold', h('div', { className: 'say' }, t('person.ready')));
  document.body.dataset.screen = 'hold';
}

function taken() {
  screen('hold', h('div', { className: 'say' }, t('person.taken')));
  document.body.dataset.screen = 'taken';
}

function free() {
  screen('free', h('div', {}, h('div', { className: 'say' }, t('person.thanks')), h('div', { className: 'sub' }, t('person.leave'))));
  document.body.dataset.screen = 'free';
  timer = setTimeout(guide, THANKS_MS);
}

function again() {
  screen('', h('div', {}, h('div', { className: 'say' }, t('person.again')), h('div', { className: 'sub' }, t('person.againSub'))));
  document.body.dataset.screen = 'again';
  timer = setTimeout(guide, THANKS_MS);
}

const session = await get('/session');
await loadWords(session.language);
if (!session.logged_in) location.replace('/');
listen((kind, data) => {
  if (kind === 'scan') {
    if (data.state === 'countdown') countdown(data.left_s);
    else if (data.state === 'capturing') hold();
    else if (data.state === 'writing') taken();
    else if (data.state === 'accepted') free();
    else if (outcome({ state: data.state, reasons: [data.reason] }) === 'cancelled') guide();
    else if (data.state === 'failed') again();
  } else if (kind === 'calibration' && data.running && data.countdown_s) countdown(data.countdown_s);
  else if (kind === 'calibration' && !data.running) guide();
  // A console that was started again counts no further; a scan that goes on tells of itself.
  else if (kind === 'reset') guide();
});
connect();
guide();
