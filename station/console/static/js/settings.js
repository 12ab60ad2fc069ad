// What the operator chose on this device: unit and pose.

import { store, stored } from './i18n.js';

export const settings = { unit: 'cm', pose: 'as-scanned' };

export function loadSettings(session) {
  settings.unit = stored('unit') || session.unit;
  settings.pose = stored('pose') || 'as-scanned';
}

export function choose(name, value) {
  settings[name] = value;
  store(name, value);
}

export const digits = () => (settings.unit === 'in' ? 2 : 1);
