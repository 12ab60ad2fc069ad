// A view of scans that are deleted meanwhile, on another tablet or by a command, or taken by another program.

import { get } from './api.js';
import { h } from './dom.js';
import { listen } from './events.js';
import { t } from './i18n.js';

async function missing(scanIds) {
  for (const scanId of scanIds) {
    const gone = await get(`/scans/${scanId}`).then(() => false, (error) => error.status === 404);
    if (gone) return { scan_id: scanId, state: 'deleted' };
  }
  return null;
}

// Calls `leave` and empties the view once one of its scans is gone; until the returned function is called.
export function emptyWhenGone(main, scanIds, leave) {
  return listen(async (kind, data) => {
    // What happened meanwhile was not heard.
    if (kind === 'back' || kind === 'reset') data = await missing(scanIds);
    else if (kind !== 'scan') return;
    if (!data || !['deleted', 'taken'].includes(data.state) || !scanIds.includes(data.scan_id)) return;
    leave();
    main.replaceChildren(h('div', { className: 'empty' }, h('h1', {}, t(`scan.${data.state}`)), h('p', {}, data.scan_id),
      h('a', { className: 'button', href: '#/history' }, t('history.title'))));
  });
}
