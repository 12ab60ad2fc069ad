// The guided calibration, and the stored ones.

import { freshKey, get, post, remove } from './api.js';
import { Cameras } from './cameras.js';
import { ask, h, notice } from './dom.js';
import { listen } from './events.js';
import { t, time } from './i18n.js';
import { STEPS, withButtons as said } from './remedies.js';
import { settings } from './settings.js';

const LOWEST_M = 0.3;
const HIGHEST_M = 2.2;
const LINES_SHOWN = 6;

export async function calibration(main, session) {
  const booth = await get('/booth');
  const cameras = new Cameras(booth.cameras.map((camera) => camera.name), 'cameras mini');
  for (const camera of booth.cameras) cameras.state(camera);
  const now = h('section', { className: 'card now', id: 'now', 'aria-live': 'polite' });
  const stored = h('section', { className: 'card' });
  const begin = async (step, fresh = false) => {
    try {
      show(await post('/calibration', { step, new: fresh }, { 'Idempotency-Key': freshKey() }));
      now.scrollIntoView({ block: 'nearest' }); // the button may be far below, on a telephone
    } catch (error) { notice(error.message, true); }
  };
  const say = async (word, more = {}) => { try { show(await post('/task/answer', { answer: word, ...more })); } catch (error) { notice(error.message, true); } };
  const halt = async () => { try { show(await remove('/task')); } catch (error) { notice(error.message, true); } };
  const marks = new Map();
  const mark = (step) => { const one = h('span', { className: 'chip good', 'data-done': step, hidden: true }, t('cal.done')); marks.set(step, one); return one; };
  async function progress() {
    const found = await get('/calibration');
    for (const [step, one] of marks) one.hidden = !found.done.includes(step);
    return found;
  }
  const anew = async () => {
    try {
      const { started } = await progress();
      if (started && !await ask(t('cal.new'), t('cal.sureNew', { time: time(started) }), t('cal.new'), t('cancel'), true)) return;
    } catch (error) {
      // One that cannot be read is begun anew; one that could not be asked for may be sound.
      if (error.status !== 409) { notice(error.message, true); return; }
    }
    await begin('all', true);
  };
  const buttons = [];
  const button = (step) => { const one = h('button', { 'data-step': step, onclick: () => begin(step), 'aria-label': `${t('cal.do')}: ${t(`cal.${step}`)}` }, t('cal.do')); buttons.push(one); return one; };

  function idle(task) {
    const told = task.kind === 'calibrate';
    const tell = told && (task.error || task.lines.length);
    now.className = 'card';
    now.replaceChildren(h('h2', {}, t('cal.all')),
      told && task.error ? h('div', { className: 'banner bad', id: 'task-error' }, said(task.error)) : '',
      session.recordings ? h('p', { className: 'soft' }, t('cal.recordings')) : '',
      h('div', { className: 'actions left' },
        h('button', { className: 'primary', id: 'calibrate', onclick: () => begin('all') }, t('cal.continue')),
        h('button', { id: 'anew', onclick: anew }, t('cal.new'))),
      tell ? h('div', { className: 'log', id: 'log' }, task.lines.map((line) => h('div', {}, said(line)))) : '');
  }

  const asks = (task) => task.waits_for === 'yes or no' || task.waits_for === 'height';

  // The ball's height is measured to a millimetre.
  function height() {
    const metres = settings.unit === 'in' ? 0.0254 : 0.01;
    const input = h('input', { type: 'number', id: 'height', inputMode: 'decimal', required: true,
      step: 'any', min: Math.ceil(LOWEST_M / metres), max: Math.floor(HIGHEST_M / metres) });
    return h('form', { onsubmit: (event) => {
      event.preventDefault();
      say('yes', { height_m: Math.round(1000 * metres * input.valueAsNumber) / 1000 });
    } }, h('label', { htmlFor: 'height' }, t('cal.height', { unit: t(`unit.${settings.unit}`) })), input,
    h('button', { className: 'primary' }, t('cal.go')));
  }

  function running(task) {
    const percent = /(\d+) % covered/.exec(task.progress);
    const of = /(\d+) of (\d+)/.exec(task.progress);
    const share = percent ? Number(percent[1]) / 100 : of ? Number(of[1]) / Number(of[2]) : null;
    const bar = h('progress', { max: 1, 'aria-label': said(task.progress) || t('loading') });
    if (share !== null) bar.value = share;
    now.className = 'card now';
    now.replaceChildren(h('h2', {}, task.title ? said(task.title) : t('loading')), h('p', { className: 'instruction' }, said(asks(task) ? task.question : task.instruction || task.question)),
      task.countdown_s ? h('div', { className: 'count' }, String(task.countdown_s)) : '',
      task.waits_for === 'height' ? height() : '',
      h('div', { className: 'actions left' },
        task.waits_for === 'go' ? h('button', { className: 'primary', onclick: () => say('go') }, t('cal.go')) : '',
        task.waits_for === 'yes or no' ? h('button', { className: 'primary', onclick: () => say('yes') }, t('cal.yes')) : '',
        task.waits_for === 'yes or no' ? h('button', { onclick: () => say('no') }, t('cal.no')) : '',
        task.waits_for === 'height' ? h('button', { id: 'leave-out', onclick: () => say('no') }, t('cal.leaveOut')) : '',
        h('button', { className: 'danger', id: 'halt', onclick: halt }, t('cal.stop'))),
      task.waits_for ? '' : h('div', {}, h('p', { className: 'soft' }, said(task.progress) || ' '), bar),
      h('div', { className: 'log', id: 'log' }, task.lines.slice(task.lines.length - Math.min(task.step_lines, LINES_SHOWN)).map((line) => h('div', {}, said(line)))));
  }

  function show(task) {
    const busy = task.running;
    for (const one of buttons) one.disabled = busy;
    if (busy && task.kind === 'calibrate') running(task); else idle(task);
  }

  async function list() {
    const found = await get('/calibrations');
    const used = found.find((one) => one.in_use);
    const entries = await Promise.all(found.map(async (one) => {
      const shifts = used && !one.in_use ? await get(`/calibrations/${used.name}/comparison/${one.name}`).catch(() => []) : [];
      return h('div', { className: 'stored', 'data-calibration': one.name },
        h('div', { className: 'head tight' }, h('b', {}, time(one.created)), h('span', { className: 'grow' }),
          one.in_use ? h('span', { className: 'chip good' }, t('cal.inUse')) : h('button', { onclick: () => use(one) }, t('cal.use'))),
        h('div', { className: 'small soft' }, t('cal.rms', { n: one.residual_rms_mm, cameras: one.cameras.length })),
        shifts.length ? h('details', { className: 'small' }, h('summary', {}, t('cal.compare')), ...shifts.map((shift) =>
          h('div', {}, t('cal.shift', { camera: shift.camera, mm: shift.shift_mm, deg: shift.turn_deg })))) : '');
    }));
    const elsewhere = used ? '' : (await get('/booth')).calibration;
    const words = elsewhere ? t('cal.elsewhere', { time: time(elsewhere) }) : entries.length ? '' : t('cal.none');
    stored.replaceChildren(h('h2', {}, t('cal.stored')), words && h('p', { className: 'soft' }, words), ...entries);
  }

  async function use(one) {
    if (!await ask(t('cal.use'), t('cal.sureUse', { name: time(one.created) }), t('cal.use'), t('cancel'))) return;
    try { await post(`/calibrations/${one.name}/use`); await list(); } catch (error) { notice(error.message, true); }
  }

  main.replaceChildren(
    h('div', { className: 'head' }, h('h1', {}, t('cal.title'))),
    h('div', { className: 'calibration' },
      h('div', { className: 'stack' }, now, h('h2', { className: 'small' }, t('cal.sees')), cameras.element),
      h('div', { className: 'stack' },
        h('section', { className: 'card' }, h('h2', {}, t('cal.steps')), h('ol', { className: 'steps' }, STEPS.map((step, i) =>
          h('li', {}, h('span', { className: 'n' }, String(i + 1)), h('span', { className: 'text' }, h('b', {}, t(`cal.${step}`)),
            h('span', { className: 'small soft' }, t(`cal.${step}.what`))), mark(step), button(step))))),
        stored)));
  show(await get('/task'));
  await list();
  progress().catch(() => {});
  let busy = false;
  let title = '';
  const silence = listen((kind, data) => {
    if (kind === 'camera') cameras.state(data);
    if (kind !== 'calibration') return;
    show(data);
    if (busy && !data.running) list().catch(() => {});
    if (busy !== data.running || title !== data.title) progress().catch(() => {});
    title = data.title;
    busy = data.running;
  });
  return () => { silence(); cameras.close(); };
}
