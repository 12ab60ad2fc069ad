// All scans: search, compare, delete.

import { get, remove } from './api.js';
import { startOf } from './days.js';
import { ask, h, icon, notice } from './dom.js';
import { listen } from './events.js';
import { t, time } from './i18n.js';
import { verdictChip } from './result.js';

const PAGE = 30;
const TYPING_MS = 250;

export async function history(main, session) {
  const search = h('input', { type: 'search', id: 'search', placeholder: t('history.search'), 'aria-label': t('history.search') });
  const since = h('input', { type: 'date' });
  const until = h('input', { type: 'date' });
  const body = h('tbody');
  const card = h('section', { className: 'card table-card history' });
  const more = h('button', { hidden: true, onclick: () => load(false) }, t('history.more'));
  const chosen = [];
  const compare = h('button', { className: 'primary', id: 'compare', disabled: true, onclick: () => { location.hash = `#/compare/${chosen.join('/')}`; } });
  const mayDelete = session.scopes.includes('manage');
  let cursor = '';
  let typing = null;

  function count() {
    compare.textContent = t('history.compare', { n: chosen.length });
    compare.disabled = chosen.length !== 2;
  }

  function row(scan) {
    const name = scan.label || t('result.noLabel');
    const done = scan.state === 'delivered' || scan.state === 'rescan';
    const box = h('input', { type: 'checkbox', className: 'check', disabled: !done, checked: chosen.includes(scan.scan_id), 'aria-label': t('history.choose', { name: `${name} ${time(scan.created)}` }),
      onchange: () => {
        if (box.checked) chosen.push(scan.scan_id); else chosen.splice(chosen.indexOf(scan.scan_id), 1);
        if (chosen.length > 2) { const old = chosen.shift(); const other = body.querySelector(`[data-scan="${old}"] .check`); if (other) other.checked = false; }
        count();
      } });
    return h('tr', { 'data-scan': scan.scan_id }, h('td', {}, box),
      h('td', {}, h('b', {}, name), h('div', { className: 'small soft' }, scan.scan_id)),
      h('td', {}, time(scan.created)), h('td', {}, verdictChip(scan)),
      h('td', {}, h('div', { className: 'row-actions' },
        done ? h('a', { className: 'button', href: `#/result/${scan.scan_id}` }, t('history.open')) : null,
        mayDelete ? h('button', { className: 'danger', disabled: measured(scan), title: measured(scan) && t('history.measured'), onclick: () => erase(scan, name) }, t('history.delete')) : null)));
  }

  // Its deletion would be refused.
  const measured = (scan) => scan.state === 'reconstructing';
  const copies = (receivers) => (receivers.length ? ` ${t('history.copies', { names: receivers.join(', ') })}` : '');

  async function erase(scan, name) {
    try {
      const now = await get(`/scans/${scan.scan_id}`);
      if (measured(now)) { notice(t('history.measured'), true); return; }
      const text = t('history.sureText', { name: `${name}, ${time(scan.created)}` });
      if (!await ask(t('history.sure'), text + copies(now.handed_over), t('history.delete'), t('cancel'), true)) return;
      // It may have been handed over while the question was open.
      const { handed_over: keepers } = await remove(`/scans/${scan.scan_id}`);
      notice(t('history.deleted') + copies(keepers));
      forget(scan.scan_id);
    } catch (error) { notice(error.message, true); }
  }

  function forget(scanId) {
    const at = chosen.indexOf(scanId);
    if (at >= 0) chosen.splice(at, 1);
    count();
    body.querySelector(`[data-scan="${scanId}"]`)?.remove();
  }

  async function load(fresh = true) {
    if (fresh) cursor = '';
    const query = new URLSearchParams({ text: search.value, since: since.value ? startOf(since.value) : '', until: until.value ? startOf(until.value, 1) : '', limit: PAGE, cursor });
    const page = await get(`/scans?${query}`);
    cursor = page.next;
    more.hidden = !cursor;
    if (fresh) body.replaceChildren();
    body.append(...page.scans.map(row));
    if (body.children.length) {
      card.replaceChildren(h('div', { className: 'table-scroll' }, h('table', {}, h('thead', {}, h('tr', {},
        h('th', {}, t('history.select')), h('th', {}, t('history.label')), h('th', {}, t('history.time')), h('th', {}, t('history.state')),
        h('th', { className: 'number' }, t('history.actions')))), body)));
    } else {
      card.replaceChildren(h('div', { className: 'empty' }, icon('empty'), h('p', {}, t(search.value || since.value || until.value ? 'history.nothing' : 'history.empty'))));
    }
  }

  const soon = () => { clearTimeout(typing); typing = setTimeout(() => load().catch((error) => notice(error.message, true)), TYPING_MS); };
  search.addEventListener('input', soon);
  since.addEventListener('change', soon);
  until.addEventListener('change', soon);
  main.replaceChildren(
    h('div', { className: 'head' }, h('h1', {}, t('history.title')), h('span', { className: 'grow' }), compare),
    h('div', { className: 'filters', role: 'search' }, search,
      h('label', {}, t('history.since'), since), h('label', {}, t('history.until'), until)), card, h('p', {}, more));
  count();
  await load();
  const silence = listen((kind, data) => {
    if (kind === 'scan' && ['deleted', 'taken'].includes(data.state)) forget(data.scan_id);
    else if (kind === 'result' || kind === 'job' || kind === 'reset' || kind === 'back') soon();
  });
  return () => { clearTimeout(typing); silence(); };
}
