// The API's own description, readable without the network.

import { h } from './dom.js';

const resolve = (schemas, schema) => (schema?.$ref ? schemas[schema.$ref.split('/').pop()] : schema);

function shape(schemas, schema, depth = 0) {
  const found = resolve(schemas, schema);
  if (!found || depth > 4) return '…';
  if (found.anyOf) return found.anyOf.map((one) => shape(schemas, one, depth)).join(' | ');
  if (found.enum) return found.enum.map((one) => JSON.stringify(one)).join(' | ');
  if (found.const !== undefined) return JSON.stringify(found.const);
  if (found.type === 'array') return `[${shape(schemas, found.items, depth + 1)}]`;
  if (found.type === 'object' && found.properties) {
    const pad = '  '.repeat(depth + 1);
    const lines = Object.entries(found.properties).map(([name, one]) => `${pad}${name}: ${shape(schemas, one, depth + 1)}${one.description ? `   # ${one.description}` : ''}`);
    return `{\n${lines.join('\n')}\n${'  '.repeat(depth)}}`;
  }
  return found.format || found.type || 'any';
}

function operation(schemas, path, method, one) {
  const parameters = (one.parameters || []).map((parameter) => h('li', {}, h('code', {}, parameter.name), ` (${parameter.in}${parameter.required ? ', needed' : ''}) `, parameter.description || ''));
  const body = one.requestBody?.content?.['application/json']?.schema;
  const answers = Object.entries(one.responses).map(([status, answer]) => {
    const [media, content] = Object.entries(answer.content || {})[0] || ['', {}];
    const detail = media === 'application/json' ? h('pre', {}, shape(schemas, content.schema)) : '';
    return h('div', {}, h('b', {}, status), ` ${answer.description} `, h('code', {}, media), detail);
  });
  return h('details', {}, h('summary', {}, h('span', { className: 'method' }, method.toUpperCase()), h('code', {}, path), h('span', { className: 'soft' }, (one.description || one.summary || '').split('\n')[0])),
    h('div', {}, h('p', {}, one.description || ''), parameters.length ? h('ul', {}, parameters) : '', body ? h('pre', {}, shape(schemas, body)) : '', ...answers));
}

const place = document.getElementById('docs');
const document_ = await (await fetch('/api/v1/openapi.json')).json();
const groups = new Map();
for (const [path, methods] of Object.entries(document_.paths)) {
  for (const [method, one] of Object.entries(methods)) {
    const tag = (one.tags || [''])[0];
    if (!groups.has(tag)) groups.set(tag, []);
    groups.get(tag).push(operation(document_.components.schemas, path, method, one));
  }
}
place.replaceChildren(h('div', { className: 'head' }, h('h1', {}, `${document_.info.title} ${document_.info.version}`), h('span', { className: 'grow' }),
  h('a', { className: 'button', href: '/api/v1/openapi.json', download: '' }, 'openapi.json')),
  h('p', {}, document_.info.description, ' A token (station token make) is sent as Authorization: Bearer …; requests that begin something take an Idempotency-Key. Depth pictures: WebSocket /api/v1/pictures.'),
  ...[...groups].flatMap(([tag, entries]) => [h('h2', {}, tag), ...entries]));
