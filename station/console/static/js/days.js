// Days of the reader's calendar as the API has times, in UTC.

// The moment at which a day (2026-11-21) begins where the reader is, or one that is so much later.
export function startOf(day, later = 0) {
  const [year, month, date] = day.split('-').map(Number);
  return new Date(year, month - 1, date + later).toISOString().slice(0, 19);
}
