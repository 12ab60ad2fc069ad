// The switches of pose and unit, and the table that they choose.

import { notice, press, segmented } from './dom.js';
import { t } from './i18n.js';
import { choose, settings } from './settings.js';

// `read` asks for the table in a pose and a unit, `draw` shows what came. A switch moves together with the
// table, or not at all: numbers under a wrong heading are worse than none.
export function switches(read, draw) {
  let wanted = { ...settings };
  const pose = segmented(t('result.pose'), [['as-scanned', t('result.as-scanned')], ['standard', t('result.standard')]], settings.pose, (value) => change({ pose: value }));
  const unit = segmented(t('result.unit'), [['cm', t('unit.cm')], ['in', t('unit.in')]], settings.unit, (value) => change({ unit: value }));

  async function show() {
    const mine = wanted;
    const found = await read(mine);
    // Another was tapped meanwhile, or the view was left.
    if (mine !== wanted) return;
    for (const name of ['pose', 'unit']) if (mine[name] !== settings[name]) choose(name, mine[name]);
    press(pose, settings.pose);
    press(unit, settings.unit);
    draw(found);
  }

  async function change(part) {
    wanted = { ...wanted, ...part };
    const mine = wanted;
    try { await show(); } catch (error) {
      if (mine !== wanted) return;
      wanted = { ...settings };
      notice(error.message, true);
    }
  }

  return { pose, unit, show, close: () => { wanted = null; } };
}
