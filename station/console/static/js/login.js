import { post } from './api.js';
import { h } from './dom.js';
import { t } from './i18n.js';

export function login(main, done) {
  const password = h('input', { type: 'password', id: 'password', autocomplete: 'current-password', required: true });
  const wrong = h('p', { className: 'banner bad', role: 'alert', hidden: true });
  const form = h('form', { onsubmit: async (event) => {
    event.preventDefault();
    wrong.hidden = true;
    try {
      done(await post('/session', { password: password.value }));
    } catch (error) {
      wrong.textContent = error.message;
      wrong.hidden = false;
      password.select();
    }
  } }, h('label', { htmlFor: 'password' }, t('login.password')), password, wrong, h('button', { className: 'primary', id: 'login' }, t('login.go')),
    h('p', { className: 'small soft' }, t('login.forgotten')));
  main.replaceChildren(h('div', { className: 'login card' }, h('h1', {}, t('app.title')), form));
  password.focus();
}
