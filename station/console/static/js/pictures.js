// Depth pictures over one WebSocket: the next one is asked for when this one has been drawn, so a
// slow tablet gets fewer of them and delays nobody.

const RETRY_MS = 1000;

export class Pictures {
  // draw(name, bitmap or null, somebody) is called for each camera; somebody is null where it cannot
  // be seen.
  constructor(draw) {
    this.draw = draw;
    this.closed = false;
    this.open();
  }

  open() {
    const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
    this.socket = new WebSocket(`${scheme}://${location.host}/api/v1/pictures`);
    this.socket.binaryType = 'arraybuffer';
    this.socket.onopen = () => this.ask();
    this.socket.onmessage = async (event) => { await this.show(event.data); this.ask(); };
    this.socket.onclose = () => { if (!this.closed) setTimeout(() => this.closed || this.open(), RETRY_MS); };
  }

  ask() { if (this.socket.readyState === WebSocket.OPEN) this.socket.send('next'); }

  async show(data) {
    const size = new DataView(data).getUint32(0, true);
    const { cameras } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
    let at = 4 + size;
    for (const camera of cameras) {
      if (!camera.bytes) { this.draw(camera.name, null, null); continue; }
      const file = new Blob([new Uint8Array(data, at, camera.bytes)], { type: 'image/jpeg' });
      at += camera.bytes;
      const bitmap = await createImageBitmap(file);
      this.draw(camera.name, bitmap, camera.somebody);
      bitmap.close();
    }
  }

  close() {
    this.closed = true;
    this.socket.close();
  }
}
