// Cards of cameras: picture, state, remedy.

import { h } from './dom.js';
import { said, t } from './i18n.js';
import { Pictures } from './pictures.js';

const LOOKS = { streaming: 'good', opening: 'warn', lost: 'bad', dead: 'bad', off: '' };

export class Cameras {
  constructor(names, className = 'cameras') {
    this.cards = new Map();
    this.element = h('div', { className });
    this.present = new Map();
    this.onpresence = null;
    for (const name of names) this.add(name);
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

  state(camera) {
    const card = this.cards.get(camera.name);
    if (!card) return;
    card.chip.className = `chip ${LOOKS[camera.state] ?? ''}`;
    card.chip.textContent = t(`camera.${camera.state}`);
    card.card.dataset.state = camera.state;
    const amiss = camera.state === 'lost' || camera.state === 'dead';
    card.remedy.hidden = !(amiss && camera.detail);
    card.remedy.textContent = said(camera.detail);
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

  close() { this.pictures.close(); }
}
