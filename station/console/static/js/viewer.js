// The body in 3D: surface, points, measured lines. Metres, z up, as the result has it.

import * as THREE from '../vendor/three/three.module.js';
import { OrbitControls } from '../vendor/three/OrbitControls.js';

const SKIN = 0xe2dfda;
const LINE = 0xc2410c;
const CHOSEN = 0x0b5c86;
const TOUCH_PX = 22;
const DIFFERENCE_COLOURS = [[0, '#2166ac'], [0.25, '#92c5de'], [0.5, '#f0f0ee'], [0.75, '#f4a582'], [1, '#b2182b']];

export class Viewer {
  constructor(place, label) {
    this.place = place;
    this.canvas = document.createElement('canvas');
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute('role', 'img');
    this.canvas.setAttribute('aria-label', label);
    place.prepend(this.canvas);
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(30, 1, 0.05, 50);
    this.camera.up.set(0, 0, 1);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9aa4ae, 2.1));
    const key = new THREE.DirectionalLight(0xffffff, 1.7);
    key.position.set(-2, -4, 3);
    this.scene.add(key);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener('change', () => this.render());
    this.lines = new Map();
    this.onpick = null;
    this.wanted = false;
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(place);
    this.canvas.addEventListener('keydown', (event) => this.turnByKey(event));
    this.canvas.addEventListener('pointerdown', (event) => { this.pressed = [event.clientX, event.clientY]; });
    this.canvas.addEventListener('pointerup', (event) => this.pick(event));
    this.resize();
  }

  setSurface({ positions, index }, colours = null) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
    geometry.setIndex(new THREE.BufferAttribute(index, 1));
    geometry.computeVertexNormals();
    if (colours) geometry.setAttribute('color', new THREE.BufferAttribute(colours, 3));
    const material = new THREE.MeshStandardMaterial({ color: colours ? 0xffffff : SKIN, roughness: 0.75, vertexColors: colours !== null });
    material.polygonOffset = true;
    material.polygonOffsetFactor = 1;
    material.polygonOffsetUnits = 1;
    this.surface = new THREE.Mesh(geometry, material);
    this.scene.add(this.surface);
    this.look('front');
  }

  setCloud({ positions }) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute('position', new THREE.BufferAttribute(positions, 3));
    const material = new THREE.PointsMaterial({ color: 0x0b5c86, size: 0.006 });
    this.cloud = new THREE.Points(geometry, material);
    this.cloud.visible = false;
    this.scene.add(this.cloud);
  }

  // rows: name, path [[x, y, z], ...], closed.
  setLines(rows) {
    for (const row of rows) {
      const points = row.path.map((point) => new THREE.Vector3(...point));
      if (row.closed && points.length) points.push(points[0].clone());
      if (points.length < 2) continue;
      const line = new THREE.Line(new THREE.BufferGeometry().setFromPoints(points),
        new THREE.LineBasicMaterial({ color: LINE, transparent: true, opacity: 0.55 }));
      this.lines.set(row.name, { line, points, tube: null });
      this.scene.add(line);
    }
    this.render();
  }

  show(what) {
    if (this.surface) this.surface.visible = what === 'surface';
    if (this.cloud) this.cloud.visible = what === 'cloud';
    this.render();
  }

  // The chosen line becomes a tube that is seen through the body.
  choose(name) {
    for (const [other, entry] of this.lines) {
      entry.line.material.opacity = name && other !== name ? 0.25 : 0.55;
      if (entry.tube) {
        this.scene.remove(entry.tube);
        entry.tube.geometry.dispose();
        entry.tube = null;
      }
    }
    const chosen = this.lines.get(name);
    if (chosen) {
      const curve = new THREE.CurvePath();
      for (let i = 1; i < chosen.points.length; i += 1) curve.add(new THREE.LineCurve3(chosen.points[i - 1], chosen.points[i]));
      const steps = Math.min(400, Math.max(8, 2 * chosen.points.length));
      const material = new THREE.MeshBasicMaterial({ color: CHOSEN, depthTest: false, transparent: true });
      chosen.tube = new THREE.Mesh(new THREE.TubeGeometry(curve, steps, 0.005, 6), material);
      chosen.tube.renderOrder = 5;
      this.scene.add(chosen.tube);
    }
    this.chosen = name;
    this.render();
  }

  look(side) {
    if (!this.surface) return;
    const box = new THREE.Box3().setFromObject(this.surface);
    const centre = box.getCenter(new THREE.Vector3());
    const size = box.getSize(new THREE.Vector3());
    // The tools cover the lower edge.
    centre.z -= 0.05 * size.z;
    const aspect = Math.max(0.2, this.camera.aspect);
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const away = Math.max(size.z, size.x / aspect) / (2 * half) * 1.24 + size.y / 2;
    const angle = { front: -Math.PI / 2, side: 0, back: Math.PI / 2 }[side];
    this.camera.position.set(centre.x + away * Math.cos(angle), centre.y + away * Math.sin(angle), centre.z + 0.05);
    this.controls.target.copy(centre);
    this.controls.minDistance = 0.4;
    this.controls.maxDistance = 3 * away;
    this.controls.update();
    this.render();
  }

  turnByKey(event) {
    const step = { ArrowLeft: [0.15, 0], ArrowRight: [-0.15, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
    const zoom = { '+': 0.9, '=': 0.9, '-': 1.1 }[event.key];
    if (!step && !zoom) return;
    event.preventDefault();
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (step) {
      offset.applyAxisAngle(new THREE.Vector3(0, 0, 1), step[0]);
      const aside = new THREE.Vector3(0, 0, 1).cross(offset).normalize();
      offset.applyAxisAngle(aside, step[1]);
    }
    offset.multiplyScalar(zoom || 1);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.render();
  }

  // A tap, not a drag: the nearest line on the screen within a finger's width.
  pick(event) {
    if (!this.onpick || !this.pressed) return;
    if (Math.hypot(event.clientX - this.pressed[0], event.clientY - this.pressed[1]) > 6) return;
    const box = this.canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    let best = null;
    let nearest = TOUCH_PX;
    const point = new THREE.Vector3();
    for (const [name, { points }] of this.lines) {
      for (let i = 1; i < points.length; i += 1) {
        for (const share of [0, 0.25, 0.5, 0.75]) {
          point.lerpVectors(points[i - 1], points[i], share).project(this.camera);
          const off = Math.hypot((point.x + 1) * box.width / 2 - at[0], (1 - point.y) * box.height / 2 - at[1]);
          if (off < nearest) { nearest = off; best = name; }
        }
      }
    }
    this.onpick(best);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.place;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.render();
  }

  // One frame when something changed: a still body costs a tablet nothing.
  render() {
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame(() => {
      this.wanted = false;
      this.renderer.render(this.scene, this.camera);
      const { x, y, z } = this.camera.position;
      this.canvas.dataset.eye = `${x.toFixed(3)} ${y.toFixed(3)} ${z.toFixed(3)}`;
      this.canvas.dataset.ready = this.surface ? 'yes' : 'no';
    });
  }

  close() {
    this.observer.disconnect();
    this.controls.dispose();
    this.renderer.dispose();
  }
}

// Colours for signed distances: blue smaller, red larger; +-limit metres are full colour.
export function differenceColours(signed, limit) {
  const stops = DIFFERENCE_COLOURS.map(([at, colour]) => [at, new THREE.Color(colour)]);
  const colours = new Float32Array(3 * signed.length);
  const mixed = new THREE.Color();
  signed.forEach((value, i) => {
    const share = Math.min(1, Math.max(0, 0.5 + value / (2 * limit)));
    const upper = Math.max(1, stops.findIndex(([at]) => at >= share));
    const [low, from] = stops[upper - 1];
    const [high, to] = stops[upper];
    mixed.lerpColors(from, to, (share - low) / (high - low));
    mixed.toArray(colours, 3 * i);
  });
  return colours;
}
