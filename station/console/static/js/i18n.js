// Words from one catalogue, numbers and times in the reader's way.

let words = {};
let phrases = [];
let language = 'en';
let asked = 0;
// Asked for at once, while the page's other parts are still on their way.
const coming = fetch('/static/catalogue.json').then((answer) => answer.json());

export async function loadWords(fallback) {
  const catalogue = await coming;
  const kept = stored('language');
  const wanted = catalogue[kept] ? kept : (fallback || 'en');
  // All of a language, or none of it where the console cannot be reached.
  const mine = ++asked;
  const found = wanted === 'zh' ? compiled(await (await fetch('/static/phrases.json')).json()) : [];
  if (mine !== asked) return;
  phrases = found;
  language = wanted;
  words = catalogue[language];
  document.documentElement.lang = language === 'zh' ? 'zh-CN' : 'en';
}

// What the station says (a reason, a remedy, an error) in the reader's language. The same rules as
// in station/archive/phrases.py, which prints them on the sheet.
const BETWEEN = /; (?![^(]*\))/;

function compiled(table) {
  const fixed = (english) => english.replace(/\{\w+\}/g, '').length;
  return Object.entries(table).sort((one, other) => fixed(other[0]) - fixed(one[0])).map(([english, chinese]) => {
    const parts = english.split(/\{(\w+)\}/);
    const source = parts.map((part, i) => (i % 2 ? `(?<${part}>.*?)` : part.replace(/[.*+?^${}()|[\]\\]/g, '\\$&'))).join('');
    return [new RegExp(`^${source}$`, 's'), chinese];
  });
}

export function said(text) {
  if (!phrases.length) return text;
  return text.split(BETWEEN).map((piece) => {
    for (const [pattern, chinese] of phrases) {
      const found = pattern.exec(piece);
      if (found) {
        const filled = (name, value) => (name === name.toUpperCase() ? said(value) : value);
        return chinese.replace(/\{(\w+)\}/g, (_, name) => filled(name, found.groups[name]));
      }
    }
    return piece;
  }).join('；');
}

export function t(key, values = {}) {
  const text = words[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => String(values[name] ?? ''));
}

// A cancelled scan counts as failed, but nothing went wrong.
export function outcome(scan) {
  const cancelled = scan.state === 'failed' && scan.reasons[0] === 'cancelled by the operator';
  return cancelled ? 'cancelled' : scan.state;
}

export function currentLanguage() { return language; }

export function setLanguage(value) { store('language', value); }

export function time(iso) {
  const moment = new Date(iso);
  if (!iso || Number.isNaN(moment.valueOf())) return iso || '';
  const locale = language === 'zh' ? 'zh-CN' : 'en-GB';
  return new Intl.DateTimeFormat(locale, { dateStyle: 'medium', timeStyle: 'short' }).format(moment);
}

export function stored(name) {
  try { return localStorage.getItem(`booth.${name}`); } catch { return null; }
}

export function store(name, value) {
  try { localStorage.setItem(`booth.${name}`, value); } catch { /* a browser that keeps nothing */ }
}
