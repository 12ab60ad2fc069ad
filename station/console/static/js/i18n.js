// Words from one catalogue, numbers and times in the reader's way.

let words = {};
let language = 'en';

export async function loadWords(fallback) {
  const catalogue = await (await fetch('/static/catalogue.json')).json();
  const kept = stored('language');
  language = catalogue[kept] ? kept : (fallback || 'en');
  words = catalogue[language];
  document.documentElement.lang = language === 'zh' ? 'zh-CN' : 'en';
}

export function t(key, values = {}) {
  const text = words[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => String(values[name] ?? ''));
}

export function currentLanguage() { return language; }

export function setLanguage(value) { store('language', value); }

export function time(iso) {
  if (!iso) return '';
  const locale = language === 'zh' ? 'zh-CN' : 'en-GB';
  return new Intl.DateTimeFormat(locale, { dateStyle: 'medium', timeStyle: 'short' }).format(new Date(iso));
}

export function stored(name) {
  try { return localStorage.getItem(`booth.${name}`); } catch { return null; }
}

export function store(name, value) {
  try { localStorage.setItem(`booth.${name}`, value); } catch { /* a browser that keeps nothing */ }
}
