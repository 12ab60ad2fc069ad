// What the station says; the commands that it names are buttons and views of the page.

import { said, t } from './i18n.js';

export const STEPS = ['floor', 'ball', 'mark', 'around', 'stand', 'depth', 'solve'];
// The word after a command may be the sentence's own.
const COMMAND = new RegExp(`station calibrate(?: (--new|--use(?! DATE)|(?:${STEPS.join('|')})(?![a-z])))?(?: --[a-z]+)*`, 'g');

export function withButtons(text) {
  return said(text).replace(COMMAND, (_, word) => {
    const key = word ? word.replace('--', '') : 'continue';
    return t('cal.button', { name: t(`cal.${key}`) });
  });
}

// In the other views: what the station calls a command, and the API a request, is a button or a view.
// With a step or an option, a command is the terminal's.
const ELSEWHERE = {
  'booth.start': /station start\b|POST \/api\/v1\/booth\/start/g,
  'booth.checkNow': /station check(?! ?-| [a-z(])/g,
  'nav.calibration': /station calibrate(?! ?-| [a-z(])/g,
  'nav.booth': /station status\b|GET \/api\/v1\/booth/g,
  'nav.history': /GET \/api\/v1\/scans/g,
  'history.delete': /DELETE \/api\/v1\/scans\/[\w-]+/g,
};

export function withViews(text) {
  return Object.entries(ELSEWHERE).reduce((told, [key, words]) => told.replace(words, () => t('cal.button', { name: t(key) })), said(text));
}
