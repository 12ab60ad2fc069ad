// Two scans: where the bodies differ in colours, and which measurements really do.

import { bytes, get, reached } from './api.js';
import { emptyWhenGone } from './deleted.js';
import { h } from './dom.js';
import { currentLanguage, t, time } from './i18n.js';
import { readPly } from './ply.js';
import { digits } from './settings.js';
import { switches } from './switches.js';

const FULL_COLOUR_M = 0.02;

export async function compare(main, session, first, second) {
  const path = `/scans/${first}`;
  let viewer = null;
  let closed = false;
  const place = h('section', { className: 'card viewer', 'aria-label': t('result.model') }, h('div', { className: 'wait' }, t('result.loading')));
  const head = h('tr');
  const body = h('tbody');
  const who = h('div', { className: 'small soft' });
  const surface = h('span', { className: 'small soft' });

  const table = switches(({ pose, unit }) => get(`${path}/comparison/${second}?pose=${pose}&unit=${unit}&language=${currentLanguage()}`), (found) => {
    const name = (scan) => `${scan.label || t('result.noLabel')}, ${time(scan.created)}`;
    who.replaceChildren(h('div', {}, t('compare.first', { name: name(found.first) })), h('div', {}, t('compare.second', { name: name(found.second) })));
    head.replaceChildren(h('th', {}, t('result.name')), ...['one', 'two', 'difference'].map((word) => h('th', { className: 'number' }, t(`compare.${word}`))));
    const signed = (value) => (value > 0 ? '+' : '') + value.toFixed(digits());
    body.replaceChildren(...found.rows.map((row) => {
      const look = row.real ? `number real ${row.difference > 0 ? 'up' : 'down'}` : 'number';
      return h('tr', {}, h('td', {}, row.words + (row.side ? ` (${t(`result.${row.side}`)})` : '')),
        h('td', { className: 'number' }, row.first.toFixed(digits())), h('td', { className: 'number' }, row.second.toFixed(digits())),
        h('td', { className: look }, signed(row.difference), h('span', { className: 'small soft' }, ` ± ${row.uncertainty.toFixed(digits())}`)));
    }));
    surface.textContent = t('compare.surface', { rms: (1e3 * found.surface_rms_m).toFixed(1), p95: (1e3 * found.surface_p95_m).toFixed(1) });
  });

  async function show3d() {
    try {
      const [{ Viewer, differenceColours }, mesh, signed] = await Promise.all([
        reached(import('./viewer.js')), bytes(`${path}/files/mesh.ply`), bytes(`${path}/comparison/${second}/distances`)]);
      if (closed) return;
      place.querySelector('.wait').remove();
      viewer = new Viewer(place, t('result.model'));
      viewer.setSurface(readPly(mesh), differenceColours(new Float32Array(signed), FULL_COLOUR_M));
      place.append(h('div', { className: 'tools' },
        ...['front', 'side', 'back'].map((side) => h('button', { onclick: () => viewer.look(side) }, t(`result.${side === 'back' ? 'backside' : side}`)))));
    } catch (error) {
      const wait = place.querySelector('.wait');
      if (wait) wait.textContent = error.kind === 'unreachable' ? error.message : t('result.no3d');
      console.warn(error);
    }
  }

  main.className = 'filled';
  main.replaceChildren(
    h('div', { className: 'head' }, h('div', {}, h('h1', {}, t('compare.title')), who), h('span', { className: 'grow' }),
      h('a', { className: 'button', href: `#/compare/${second}/${first}` }, t('compare.swap'))),
    h('div', { className: 'result' },
      h('div', { className: 'stack tall' }, place,
        h('div', { className: 'legend' }, t('compare.smaller'), h('span', { className: 'ramp difference' }), t('compare.larger'), ' ', t('compare.scale', { n: 1e3 * FULL_COLOUR_M }), surface,
          h('span', {}, t('compare.posed')))),
      h('section', { className: 'card table-card' },
        h('div', { className: 'bar' }, table.pose, table.unit,
          h('span', { className: 'small soft' }, t('compare.note'))),
        h('div', { className: 'table-scroll', tabIndex: 0, role: 'region', 'aria-label': t('compare.title') },
          h('table', { id: 'compared' }, h('thead', {}, head), body)))));
  await table.show();
  show3d();
  const leave = () => {
    if (closed) return;
    closed = true;
    silence();
    table.close();
    if (viewer) viewer.close();
  };
  const silence = emptyWhenGone(main, [first, second], leave);
  return leave;
}
