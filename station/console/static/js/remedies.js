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

// In the other views: with a step or an option, a command is the terminal's.
const ELSEWHERE = /station (check|calibrate)(?! ?-| [a-z(])/g;

export function withViews(text) {
  return said(text).replace(ELSEWHERE, (_, word) => t('cal.button', { name: t(word === 'check' ? 'booth.checkNow' : 'nav.calibration') }));
}
