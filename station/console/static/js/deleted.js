// A view of scans that are deleted meanwhile, on another tablet or by a command, or taken by another program.

import { h } from './dom.js';
import { listen } from './events.js';
import { t } from './i18n.js';

// Calls `leave` and empties the view once one of its scans is gone; until the returned function is called.
export function emptyWhenGone(main, scanIds, leave) {
  return listen((kind, data) => {
    if (kind !== 'scan' || !['deleted', 'taken'].includes(data.state) || !scanIds.includes(data.scan_id)) return;
    leave();
    main.replaceChildren(h('div', { className: 'empty' }, h('h1', {}, t(`scan.${data.state}`)), h('p', {}, data.scan_id),
      h('a', { className: 'button', href: '#/history' }, t('history.title'))));
  });
}
