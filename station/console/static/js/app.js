// The page's frame: who is logged in, which view is shown, whether the console answers.

import { get, reached, remove } from './api.js';
import { h, icon, notice } from './dom.js';
import { connect, disconnect, listen } from './events.js';
import { currentLanguage, loadWords, setLanguage, t } from './i18n.js';
import { login } from './login.js';
import { loadSettings } from './settings.js';

const VIEWS = {
  booth: () => import('./booth.js').then((module) => module.booth),
  scan: () => import('./scan.js').then((module) => module.scan),
  history: () => import('./history.js').then((module) => module.history),
  calibration: () => import('./calibration.js').then((module) => module.calibration),
  result: () => import('./result.js').then((module) => module.result),
  compare: () => import('./compare.js').then((module) => module.compare),
};
const RAIL = ['scan', 'booth', 'history', 'calibration'];
// A view that is not drawn by then says so: the one before it hears nothing any more.
const SLOW_MS = 700;
const BELONGS = { result: 'history', compare: 'history' };

const main = document.getElementById('main');
const rail = document.getElementById('rail');
let session = null;
let leave = () => {};
let shown = null;
let turn = 0;
let failed = false;

function drawRail() {
  rail.setAttribute('aria-label', t('nav.main'));
  rail.hidden = false;
  const languages = h('select', { id: 'language', 'aria-label': t('nav.language'), onchange: (event) => speak(event.target.value) }, h('option', { value: 'en' }, 'English'), h('option', { value: 'zh' }, '简体中文'));
  languages.value = currentLanguage();
  rail.replaceChildren(
    ...RAIL.map((name) => h('a', { href: `#/${name}`, 'data-view': name }, icon(name), h('span', {}, t(`nav.${name}`)))),
    h('span', { className: 'spacer' }),
    h('a', { href: '/person', target: '_blank', rel: 'noopener' }, icon('person'), h('span', {}, t('nav.person'))),
    languages,
    session.password_set ? h('button', { id: 'logout', onclick: logOut }, t('nav.logout')) : '');
}

// Without loading the page anew: what it tells of a scan, and its notices, stay.
async function speak(language) {
  const before = currentLanguage();
  setLanguage(language);
  try { await reached(load(session.language)); } catch (error) {
    const chosen = document.getElementById('language');
    if (chosen.value !== language) return; // another one meanwhile
    setLanguage(before);
    chosen.value = before;
    notice(error.message, true);
    return;
  }
  drawRail();
  document.getElementById('language').focus();
  show({ again: true });
}

async function load(fallback) {
  await loadWords(fallback);
  document.getElementById('skip').textContent = t('app.skip');
}

async function logOut() {
  try { await remove('/session'); } catch (error) { notice(error.message, true); return; }
  location.reload();
}

function wanted() {
  const [, name = 'scan', ...rest] = location.hash.split('/');
  return [VIEWS[name] ? name : 'scan', rest];
}

async function show({ again = false } = {}) {
  const [view, rest] = wanted();
  const mine = ++turn;
  shown = String([view, ...rest]);
  failed = false;
  leave();
  leave = () => {};
  for (const link of rail.querySelectorAll('[data-view]')) {
    if (link.dataset.view === (BELONGS[view] ?? view)) link.setAttribute('aria-current', 'page');
    else link.removeAttribute('aria-current');
  }
  const waiting = setTimeout(() => {
    if (mine === turn) main.replaceChildren(h('p', { className: 'empty', role: 'status' }, t('loading')));
  }, SLOW_MS);
  document.title = `${t(`${view === 'calibration' ? 'cal' : view}.title`)} – ${t('app.title')}`;
  try {
    const draw = await reached(VIEWS[view]());
    // Drawn aside: a slow view that was left meanwhile must not cover the one that came after it.
    const place = h('div');
    const left = await draw(place, { ...session, again }, ...rest.map(decodeURIComponent));
    if (mine !== turn) { left(); return; }
    clearTimeout(waiting);
    main.replaceChildren(place);
    if (!again) main.scrollTop = 0; // of the view before
    leave = left;
  } catch (error) {
    clearTimeout(waiting);
    if (mine !== turn || error.kind === 'not-logged-in') return;
    failed = true;
    main.replaceChildren(h('div', { className: 'empty' }, h('h1', {}, t('error')), h('p', { role: 'alert' }, error.message)));
  }
}

function enter(found) {
  session = found;
  loadSettings(session);
  drawRail();
  connect();
  show();
}

function leaveForLogin() {
  turn += 1;
  leave();
  leave = () => {};
  disconnect();
  rail.hidden = true;
  session = null;
  login(main, enter);
}

let lostNotice = null;
listen((kind) => {
  if (kind === 'lost' && !lostNotice) {
    lostNotice = h('div', { className: 'notice bad', id: 'lost' }, t('lost'));
    document.getElementById('notices').append(lostNotice);
  } else if (kind === 'back' && lostNotice) {
    lostNotice.remove();
    lostNotice = null;
    notice(t('back'));
    if (failed) show();
  }
});
// Not the first view, whose address is given after it was shown: it may be in use.
window.addEventListener('hashchange', () => { if (failed || String(wanted().flat()) !== shown) show(); });
// Its address would be a view's.
document.getElementById('skip').addEventListener('click', (event) => { event.preventDefault(); main.focus(); });
window.addEventListener('booth-login', () => { if (session) leaveForLogin(); });

VIEWS[wanted()[0]]().catch(() => {}); // on its way while the session is asked for
const found = await get('/session');
await load(found.language);
if (found.logged_in) enter(found); else leaveForLogin();
