// Elements from code: text is always text, whatever a label holds.

export function h(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name in element && !['list', 'form', 'role'].includes(name)) element[name] = value;
    else element.setAttribute(name, value === true ? '' : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

const SVG = 'http://www.w3.org/2000/svg';

export function s(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

const ICONS = {
  booth: 'M4 5h16v14H4zM4 9l5-4M20 9l-5-4M12 11v5M9.5 19v-3h5v3',
  scan: 'M4 8V4h4M16 4h4v4M20 16v4h-4M8 20H4v-4M12 7.5a1.6 1.6 0 1 0 0 .01M12 10v5M9 11.5l3-1.5 3 1.5M10 19l2-4 2 4',
  history: 'M4 12a8 8 0 1 0 2.5-5.8L4 8.5M4 4v4.5h4.5M12 8v4.5l3 2',
  calibration: 'M12 3v4M12 17v4M3 12h4M17 12h4M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8z',
  person: 'M12 7a2 2 0 1 0 0-.01M12 10v6M7 15l5-5 5 5M9.5 21l2.5-5 2.5 5M3 3h18',
  empty: 'M4 7h16v13H4zM4 7l3-4h10l3 4M9 12h6',
};

export function icon(name) {
  return s('svg', { viewBox: '0 0 24 24', fill: 'none', stroke: 'currentColor', 'stroke-width': 1.7,
    'stroke-linecap': 'round', 'stroke-linejoin': 'round', 'aria-hidden': 'true' },
    s('path', { d: ICONS[name] }));
}

export function notice(text, bad = false) {
  const place = document.getElementById('notices');
  if (!place) return;
  const box = h('div', { className: bad ? 'notice bad' : 'notice' }, text);
  place.append(box);
  setTimeout(() => box.remove(), bad ? 9000 : 4000);
}

// A question that cannot be missed; resolves to whether it was affirmed.
export function ask(title, text, yes, no, danger = false) {
  return new Promise((resolve) => {
    const dialog = h('dialog', { 'aria-labelledby': 'question' },
      h('h2', { id: 'question' }, title), h('p', {}, text),
      h('div', { className: 'actions' },
        h('button', { onclick: () => dialog.close('no'), autofocus: true }, no),
        h('button', { className: danger ? 'danger' : 'primary', id: 'affirm',
          onclick: () => dialog.close('yes') }, yes)));
    dialog.addEventListener('close', () => { dialog.remove(); resolve(dialog.returnValue === 'yes'); });
    document.body.append(dialog);
    dialog.showModal();
  });
}

// One of several; who is told of a tap presses the button when the choice is carried out.
export function segmented(label, options, chosen, choose) {
  const group = h('div', { className: 'segmented', role: 'group', 'aria-label': label }, options.map(([value, words]) =>
    h('button', { type: 'button', 'data-value': value, onclick: () => choose(value) }, words)));
  press(group, chosen);
  return group;
}

export function press(group, value) {
  for (const button of group.children) button.setAttribute('aria-pressed', String(button.dataset.value === value));
}
