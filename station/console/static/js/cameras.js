// Cards of cameras: picture, state, remedy.

import { get } from './api.js';
import { h } from './dom.js';
import { isLost, listen } from './events.js';
import { t } from './i18n.js';
import { Pictures } from './pictures.js';
import { withViews as said } from './remedies.js';

const LOOKS = { streaming: 'good', opening: 'warn', lost: 'bad', dead: 'bad', off: '' };

export class Cameras {
  constructor(names, className = 'cameras') {
    this.cards = new Map();
    this.element = h('div', { className });
    this.present = new Map();
    this.onpresence = null;
    for (const name of names) this.add(name);
    this.silence = listen((kind) => {
      if (kind === 'lost') this.forget();
      else if (kind === 'back') this.look();
    });
    this.pictures = new Pictures((name, bitmap, somebody) => this.draw(name, bitmap, somebody));
  }

  add(name) {
    const canvas = h('canvas', { width: 320, height: 240, role: 'img', 'aria-label': t('camera.picture', { name }) });
    const chip = h('span', { className: 'chip' }, '…');
    const remedy = h('p', { className: 'remedy', hidden: true });
    const card = h('article', { className: 'card camera', 'data-camera': name },
      canvas, h('header', {}, h('span', {}, name), chip), remedy);
    this.cards.set(name, { canvas, chip, remedy, card, frames: 0 });
    this.element.append(card);
  }

  // Who hears nothing knows nothing of the cameras.
  forget() {
    for (const name of this.cards.keys()) {
      this.state({ name });
      this.draw(name, null, null);
    }
  }

  async look() {
    try {
      for (const camera of (await get('/booth')).cameras) this.state(camera);
    } catch { /* lost again */ }
  }

  state(camera) {
    const card = this.cards.get(camera.name);
    if (!card) return;
    const state = isLost() ? 'unknown' : camera.state;
    card.chip.className = `chip ${LOOKS[state] ?? ''}`;
    card.chip.textContent = t(`camera.${state}`);
    card.card.dataset.state = state;
    const amiss = state === 'lost' || state === 'dead';
    card.remedy.textContent = amiss ? said(camera.detail) : '';
    card.remedy.hidden = !card.remedy.textContent;
  }

  draw(name, bitmap, somebody) {
    const card = this.cards.get(name);
    if (!card) return;
    const context = card.canvas.getContext('2d');
    const { width, height } = card.canvas;
    if (bitmap) {
      context.drawImage(bitmap, 0, 0, width, height);
      card.card.dataset.frames = String(++card.frames);
    } else {
      context.fillStyle = '#1e242e';
      context.fillRect(0, 0, width, height);
      context.fillStyle = '#9fb0c0';
      context.font = '17px system-ui, sans-serif';
      context.textAlign = 'center';
      context.fillText(t('camera.pause'), width / 2, height / 2);
    }
    this.present.set(name, somebody);
    if (this.onpresence) this.onpresence(this.somebody());
  }

  // Whether any camera sees somebody; null if none can tell.
  somebody() {
    const seen = [...this.present.values()].filter((somebody) => somebody !== null);
    return seen.length ? seen.some(Boolean) : null;
  }

  close() {
    this.silence();
    this.pictures.close();
  }
}
