// A body in outline, its parts named as the reconstruction names them.

import { s } from './dom.js';
import { t } from './i18n.js';

// The right half as the viewer sees it is the person's left. Polygons in a box of 160 x 340.
const MIDDLE = {
  head: 'M80 8c13 0 20 11 20 24s-9 27-20 27-20-14-20-27S67 8 80 8z',
  neck: 'M71 60h18v16H71z',
  chest: 'M60 78h40l4 44H56z',
  abdomen: 'M56 124h48l-2 34H58z',
  pelvis: 'M57 160h46l5 32-28 8-28-8z',
};
const LEFT = {
  shoulder: 'M101 78c10 1 17 6 20 14l-16 12z',
  upper_arm: 'M106 104l16-11 12 46-12 5z',
  forearm: 'M122 146l13-5 13 44-9 4z',
  hand: 'M139 191l11-4 6 20-6 10-7-6z',
  thigh: 'M82 203l26-9-4 64-20 2z',
  shin: 'M84 262l20-2-5 56H88z',
  foot: 'M87 318h13l8 14H86z',
};

// Without a list, the parts in question are not known (yet).
export function bodyFigure(parts = null) {
  const doubtful = parts ?? [];
  const names = doubtful.map((name) => t(`part.${name}`)).join(', ');
  const label = names ? t('scan.figure', { parts: names }) : t('scan.figureGood');
  const told = parts ? { role: 'img', 'aria-label': label } : { 'aria-hidden': 'true' };
  const figure = s('svg', { viewBox: '0 0 160 340', class: 'body-figure', ...told });
  const part = (name, d, mirrored) => {
    const marked = doubtful.includes(name);
    const transform = mirrored ? 'translate(160 0) scale(-1 1)' : null;
    figure.append(s('path', { d, transform, class: marked ? 'part doubtful' : 'part', 'data-part': name }));
  };
  for (const [name, d] of Object.entries(MIDDLE)) part(name, d, false);
  for (const [name, d] of Object.entries(LEFT)) {
    part(`${name}_left`, d, false);
    part(`${name}_right`, d, true);
  }
  return figure;
}
