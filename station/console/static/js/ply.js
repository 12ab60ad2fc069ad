// Reads the PLY files of a result: binary, little endian, float properties, triangles.

export function readPly(buffer) {
  const bytes = new Uint8Array(buffer);
  const end = headerEnd(bytes);
  const lines = new TextDecoder().decode(bytes.subarray(0, end)).split('\n');
  let vertices = 0;
  let faces = 0;
  let properties = 0;
  let element = '';
  for (const line of lines) {
    const [word, kind, count] = line.split(' ');
    if (word === 'element') {
      element = kind;
      if (kind === 'vertex') vertices = Number(count);
      if (kind === 'face') faces = Number(count);
    } else if (word === 'property' && element === 'vertex') properties += 1;
  }
  const table = new Float32Array(buffer.slice(end, end + 4 * vertices * properties));
  const positions = new Float32Array(3 * vertices);
  for (let i = 0; i < vertices; i += 1) {
    for (let axis = 0; axis < 3; axis += 1) positions[3 * i + axis] = table[properties * i + axis];
  }
  const view = new DataView(buffer, end + 4 * vertices * properties);
  const index = new Uint32Array(3 * faces);
  for (let face = 0; face < faces; face += 1) {
    for (let corner = 0; corner < 3; corner += 1) {
      index[3 * face + corner] = view.getInt32(13 * face + 1 + 4 * corner, true);
    }
  }
  return { positions, index };
}

function headerEnd(bytes) {
  const mark = new TextEncoder().encode('end_header\n');
  outer: for (let at = 0; at < Math.min(bytes.length, 4096); at += 1) {
    for (let i = 0; i < mark.length; i += 1) if (bytes[at + i] !== mark[i]) continue outer;
    return at + mark.length;
  }
  throw new Error('not a PLY file');
}
