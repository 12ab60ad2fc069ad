// A result: the body, its lines and its table, which light each other up.

import { address, bytes, get, reached } from './api.js';
import { emptyWhenGone } from './deleted.js';
import { h, press, segmented } from './dom.js';
import { currentLanguage, outcome, t, time } from './i18n.js';
import { readPly } from './ply.js';
import { withViews as said } from './remedies.js';
import { digits, settings } from './settings.js';
import { switches } from './switches.js';

const LOOKS = { ok: 'good', rescan: 'warn', failed: 'bad' };

const size = (count) => (count < 1e5 ? `${Math.ceil(count / 1e3)} kB` : `${(count / 1e6).toFixed(1)} MB`);

export function verdictChip(scan) {
  const ended = outcome(scan);
  const look = ended === 'cancelled' ? '' : LOOKS[scan.verdict] ?? '';
  return h('span', { className: `chip ${look}` }, t(`state.${ended}`));
}

export async function result(main, session, scanId) {
  const path = `/scans/${scanId}`;
  const scan = await get(path);
  if (!['delivered', 'rescan'].includes(scan.state)) {
    main.replaceChildren(h('div', { className: 'empty' }, h('h1', {}, scan.label || scanId), h('p', {}, t('result.gone')),
      verdictChip(scan), h('p', {}, said(scan.reasons.join('; ')))));
    return () => {};
  }
  let chosen = null;
  let viewer = null;
  let closed = false;
  const place = h('section', { className: 'card viewer', 'aria-label': t('result.model') },
    h('div', { className: 'name', id: 'line-name' }, t('result.tap')), h('div', { className: 'wait' }, t('result.loading')));
  const body = h('tbody', { className: 'rows', id: 'rows' });
  const sides = h('tbody', { className: 'sides', id: 'differences' });
  const query = ({ pose, unit }) => `pose=${pose}&unit=${unit}&language=${currentLanguage()}`;
  const note = h('p', { className: 'small soft', hidden: true }, t('result.standardNote'));

  const table = switches((wanted) => get(`${path}/measurements?${query(wanted)}`), ({ rows, differences }) => {
    note.hidden = settings.pose !== 'standard';
    body.replaceChildren(...rows.map((row) => {
      const side = row.side ? ` (${t(`result.${row.side}`)})` : '';
      const name = row.words + side;
      return h('tr', { 'data-name': row.name, 'data-words': name, tabIndex: 0, 'aria-selected': 'false', onclick: () => pick(row.name),
        onkeydown: (event) => { if (['Enter', ' '].includes(event.key)) { event.preventDefault(); pick(row.name); } } },
        h('td', {}, name),
        h('td', { className: 'number' }, h('b', {}, row.value === null ? '–' : row.value.toFixed(digits()))),
        h('td', { className: 'number interval' }, row.value === null ? t('result.missing') : `${row.low.toFixed(digits())} – ${row.high.toFixed(digits())}`,
          ['partly', 'inferred'].includes(row.basis) ? h('div', {}, t(`result.${row.basis}`)) : null));
    }));
    const signed = (value) => (value > 0 ? '+' : '') + value.toFixed(digits());
    sides.replaceChildren(...(differences.length ? [h('tr', {}, h('th', { colSpan: 3, scope: 'rowgroup' }, t('result.sides')))] : []),
      ...differences.map((row) => h('tr', { 'data-difference': row.name, className: row.real ? 'real' : '' }, h('td', {}, row.words),
        h('td', { className: 'number' }, row.real ? h('b', {}, signed(row.value)) : signed(row.value)),
        h('td', { className: 'number interval' }, `${signed(row.low)} – ${signed(row.high)}`))));
    pick(chosen, false);
    links();
  });

  function pick(name, toggle = true) {
    chosen = toggle && chosen === name ? null : name;
    for (const row of body.children) {
      const mine = row.dataset.name === chosen;
      row.setAttribute('aria-selected', String(mine));
      if (mine) {
        row.scrollIntoView({ block: 'nearest' });
        place.querySelector('#line-name').textContent = `${row.dataset.words}: ${row.querySelector('b').textContent} ${t(`unit.${settings.unit}`)}`;
      }
    }
    if (!chosen) place.querySelector('#line-name').textContent = t('result.tap');
    if (viewer) viewer.choose(chosen);
  }

  async function show3d() {
    try {
      const [{ Viewer }, mesh, lines, cloud] = await Promise.all([
        reached(import('./viewer.js')), bytes(`${path}/files/mesh.ply`), get(`${path}/files/measurements.json`), bytes(`${path}/files/cloud.ply`)]);
      if (closed) return;
      place.querySelector('.wait').remove();
      viewer = new Viewer(place, t('result.model'));
      viewer.setSurface(readPly(mesh));
      viewer.setCloud(readPly(cloud));
      viewer.setLines(lines.measurements);
      viewer.onpick = (name) => { if (name) pick(name); };
      viewer.choose(chosen);
      const look = segmented(t('result.view'), [['surface', t('result.surface')], ['cloud', t('result.cloud')]], 'surface', (what) => { viewer.show(what); press(look, what); });
      place.append(h('div', { className: 'tools' },
        look,
        ...['front', 'side', 'back'].map((side) => h('button', { onclick: () => viewer.look(side) }, t(`result.${side === 'back' ? 'backside' : side}`)))));
    } catch (error) {
      const wait = place.querySelector('.wait');
      if (wait) wait.textContent = error.kind === 'unreachable' ? error.message : t('result.no3d');
      console.warn(error);
    }
  }

  const menu = h('div', { hidden: true, id: 'downloads' });
  function links() {
    const item = (words, href, size) => h('a', { href: address(href), download: '' }, h('span', {}, words), h('span', { className: 'soft small' }, size || ''));
    menu.replaceChildren(
      item(t('result.zip'), `${path}/result.zip?${query(settings)}`),
      item(t('result.pdf'), `${path}/sheet.pdf?${query(settings)}`),
      item(t('result.csv'), `${path}/measurements.csv?${query(settings)}`),
      item(t('result.smis'), `${path}/individual.smis?pose=${settings.pose}`),
      ...files.map((file) => item(file.name, `${path}/files/${file.name}`, size(file.bytes))));
    print.href = address(`${path}/sheet.pdf?${query(settings)}`);
  }

  const files = await get(`${path}/files`);
  const print = h('a', { className: 'button', id: 'print', target: '_blank', rel: 'noopener' }, t('result.print'));
  const opener = h('button', { id: 'download', 'aria-expanded': 'false', 'aria-controls': 'downloads', onclick: () => {
    menu.hidden = !menu.hidden;
    opener.setAttribute('aria-expanded', String(!menu.hidden));
  } }, t('result.download'));
  main.className = 'filled';
  main.replaceChildren(
    h('div', { className: 'head' }, h('div', {}, h('h1', {}, scan.label || t('result.noLabel')),
      h('span', { className: 'small soft' }, `${time(scan.created)} · ${scan.scan_id}`)), verdictChip(scan), h('span', { className: 'grow' }),
      print, h('div', { className: 'menu' }, opener, menu)),
    scan.reasons.length ? h('div', { className: 'banner warn' }, t(scan.state === 'rescan' ? 'result.reasons' : 'result.remarks', { words: said(scan.reasons.join('; ')) })) : '',
    h('div', { className: 'result' }, place,
      h('section', { className: 'card table-card' },
        h('div', { className: 'bar' }, table.pose, table.unit, note),
        h('div', { className: 'table-scroll', tabIndex: 0, role: 'region', 'aria-label': t('result.title') },
          h('table', {}, h('thead', {}, h('tr', {}, h('th', {}, t('result.name')), h('th', { className: 'number' }, t('result.value')),
            h('th', { className: 'number' }, t('result.interval')))), body, sides)))));
  const shut = (event) => { if (!event.target.closest('.menu')) { menu.hidden = true; opener.setAttribute('aria-expanded', 'false'); } };
  const escape = (event) => {
    if (event.key !== 'Escape' || menu.hidden) return;
    shut({ target: document.body });
    opener.focus();
  };
  document.addEventListener('click', shut);
  document.addEventListener('keydown', escape);
  await table.show();
  show3d();
  const leave = () => {
    if (closed) return;
    closed = true;
    silence();
    table.close();
    document.removeEventListener('click', shut);
    document.removeEventListener('keydown', escape);
    if (viewer) viewer.close();
  };
  const silence = emptyWhenGone(main, [scanId], leave);
  return leave;
}
