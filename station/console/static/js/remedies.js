// What the station says of a calibration; the commands that it names are buttons on the page.

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
