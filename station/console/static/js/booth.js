// The booth: what the cameras see, what is wrong and what to do.

import { get, post, freshKey } from './api.js';
import { Cameras } from './cameras.js';
import { h, notice } from './dom.js';
import { listen } from './events.js';
import { t, time } from './i18n.js';
import { withViews as said } from './remedies.js';
import { troubleBanner } from './troubles.js';

const REFRESH_MS = 5000;

// A stored calibration is named by its date, without the marks between the numbers.
function calibrated(name) {
  if (!name) return t('booth.none');
  return time(name.replace(/^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)Z$/, '$1-$2-$3T$4:$5:$6Z'));
}

export async function booth(main) {
  const look = () => Promise.all([get('/booth'), get('/task')]);
  let state;
  let checking;
  const take = ([found, task]) => { state = found; checking = task.running && task.kind === 'check'; };
  take(await look());
  const cameras = new Cameras(state.cameras.map((camera) => camera.name));
  const power = h('button', { id: 'power', onclick: () => switchSensors() });
  const facts = h('dl', { className: 'facts' });
  const [banner, showTroubles] = troubleBanner();
  const checkText = h('p', { className: 'small' });
  const checkButton = h('button', { id: 'check', onclick: () => check() }, t('booth.checkNow'));
  const waitingList = h('div');
  const tryNow = h('button', { id: 'try-now', onclick: () => handOver() }, t('booth.tryNow'));
  const deliveries = h('div', { className: 'card', hidden: true },
    h('h2', {}, t('booth.deliveries')), waitingList, tryNow);

  async function switchSensors() {
    power.disabled = true;
    try {
      await post(state.streaming ? '/booth/stop' : '/booth/start');
    } catch (error) { notice(error.message, true); }
    await refresh();
    power.disabled = false;
  }

  async function handOver() {
    tryNow.disabled = true;
    try { await post('/booth/hand-over'); } catch (error) { notice(error.message, true); }
    tryNow.disabled = false;
  }

  async function check() {
    checking = true;
    show();
    try {
      await post('/booth/check', {}, { 'Idempotency-Key': freshKey() });
    } catch (error) {
      notice(error.message, true);
      checking = false;
      show();
    }
  }

  function checked(last) {
    const parts = [];
    if (last.moved.length) parts.push(t('booth.checkMoved', { moves: said(last.moves.join('; ')) }));
    if (last.changed.length) parts.push(t('booth.checkChanged', { names: last.changed.join(', ') }));
    if (!parts.length) parts.push(t('booth.checkGood'));
    if (last.depths) parts.push(said(last.depths));
    return parts.join(' ');
  }

  function show() {
    for (const camera of state.cameras) cameras.state(camera);
    power.textContent = t(state.streaming ? 'booth.stop' : 'booth.start');
    power.className = state.streaming ? '' : 'primary';
    const rate = state.framesets_hz === null ? '–' : t('booth.perSecond', { n: state.framesets_hz.toFixed(0) });
    const rows = [
      [t('booth.rate'), state.streaming ? rate : '–'],
      [t('booth.queue'), String(state.spool.queue + state.spool.work)],
      [t('booth.failed'), String(state.failed)],
      [t('booth.cancelled'), String(state.cancelled)],
      [t('booth.disk'), `${(state.disk_free_mb / 1000).toFixed(1)} GB`],
      [t('booth.calibration'), calibrated(state.calibration)],
    ];
    facts.replaceChildren(...rows.flatMap(([name, value]) => [h('dt', {}, name),
      h('dd', { className: value.length > 12 ? 'wide' : '' }, value)]));
    showTroubles(state);
    const last = state.last_check;
    const ended = last === null ? t('booth.never') : `${time(last.time)} – ${checked(last)}`;
    checkText.textContent = checking ? t('booth.checking') : ended;
    checkButton.disabled = checking;
    const waiting = state.waiting_deliveries;
    deliveries.hidden = waiting.length === 0;
    waitingList.replaceChildren(
      ...waiting.slice(0, 8).map((one) => h('p', { className: 'small' }, `${one.scan_id} → ${one.target}${one.error ? `: ${said(one.error)}` : ''}`)),
      waiting.length > 8 ? h('p', { className: 'small' }, t('booth.moreWaiting', { n: waiting.length - 8 })) : '');
  }

  async function refresh() {
    try {
      take(await look());
      show();
    } catch { /* the connection's loss is told elsewhere */ }
  }

  main.replaceChildren(
    h('div', { className: 'head' }, h('h1', {}, t('booth.title')), h('span', { className: 'grow' }), power),
    banner,
    h('div', { className: 'booth' },
      h('div', {}, cameras.element,
        h('div', { className: 'legend' }, h('span', { className: 'ramp depth' }), t('booth.legend'),
          h('span', {}, h('span', { className: 'box grey' }), t('booth.outside')),
          h('span', {}, h('span', { className: 'box white' }), t('booth.outline')))),
      h('div', { className: 'stack' },
        h('section', { className: 'card' }, facts),
        h('section', { className: 'card' }, h('h2', {}, t('booth.check')), checkText, checkButton,
          h('p', { className: 'small soft' }, t('booth.checkHow'))),
        deliveries)));
  show();
  const timer = setInterval(refresh, REFRESH_MS);
  const silence = listen((kind, data) => {
    if (kind === 'camera') {
      const at = state.cameras.findIndex((camera) => camera.name === data.name);
      if (at >= 0) state.cameras[at] = data;
      cameras.state(data);
    } else if (kind === 'framesets') {
      state.framesets_hz = data.rate_hz;
      state.streaming = data.streaming;
      show();
    } else if (kind === 'calibration' && data.kind === 'check') {
      checking = data.running;
      if (!checking && data.error) notice(said(data.error), true);
      refresh();
    } else if (kind !== 'scan') refresh();
  });
  return () => { clearInterval(timer); silence(); cameras.close(); };
}
