"use strict";
function main(data) {
  const canvas = one("canvas");
  const stage = one(".stage");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  const scene = new THREE.Scene();
  const eye = new THREE.PerspectiveCamera(45, 1, 0.5, 50000);
  eye.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(eye, canvas);
  controls.screenSpacePanning = false;

  const geometry = cityGeometry(data.city);
  const walls = new THREE.MeshLambertMaterial({
    flatShading: true, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
  });
  const ink = new THREE.LineBasicMaterial();
  const edges = new THREE.LineSegments(new THREE.EdgesGeometry(geometry, 25), ink);
  scene.add(new THREE.Mesh(geometry, walls), edges);
  const sun = new THREE.DirectionalLight(0xffffff, 2);
  sun.position.set(-0.5, -0.8, 1.4);
  scene.add(sun, new THREE.AmbientLight(0xffffff, 1.6));

  // Where the cameras and what they look at are.
  const places = data.cameras.flatMap((each) => KINDS.filter((k) => each[k]).map((k) => new THREE.Vector3(...each[k].center)));
  const low = places.reduce((a, b) => a.clone().min(b));
  const high = places.reduce((a, b) => a.clone().max(b));
  const ground = groundBelow(geometry, low, high);
  const reach = Math.max(high.x - low.x, high.y - low.y, high.z - ground, 60);
  const usual = Math.min(0.12 * Math.max(high.z - ground, 20), 0.25 * reach);
  const tiles = 50;
  const grid = new THREE.GridHelper(tiles * 2 * Math.ceil(reach / tiles + 4), 4 * Math.ceil(reach / tiles + 4));
  grid.rotation.x = Math.PI / 2;
  grid.position.z = ground - 0.2;
  scene.add(grid);

  // One drawing per kind of camera: lines to look at, faces to point at.
  const parts = {};
  for (const kind of KINDS) {
    const lines = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial());
    const faces = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({
      side: THREE.DoubleSide, transparent: true, opacity: 0.1, depthWrite: false }));
    lines.frustumCulled = faces.frustumCulled = false;
    scene.add(lines, faces);
    parts[kind] = { lines, faces, owners: [] };
  }
  const moves = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial());
  const chosen = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ depthTest: false }));
  moves.frustumCulled = chosen.frustumCulled = false;
  const photos = new THREE.Group();
  scene.add(moves, chosen, photos);

  const hidden = new Set();
  let current = null; // the camera chosen
  let through = null; // the camera looked through, and from where one came
  const size = () => usual * Number(one(".size").value);
  const isOn = (kind) => one(`[data-kind="${kind}"]`)?.checked ?? false;
  const best = (each) => each.estimate ?? each.truth ?? each.prior;
  const corners = (pose, depth) => [0, 1, 2, 3].map((i) =>
    pose.center.map((value, axis) => value + depth * pose.rays[3 * i + axis]));
  const fill = (object, values) => {
    object.geometry.dispose();
    object.geometry.setAttribute("position", new THREE.Float32BufferAttribute(values, 3));
    object.geometry.computeBoundingSphere();
  };
  const frame = (pose, depth) => {
    const c = corners(pose, depth);
    return [0, 1, 2, 3].flatMap((i) => [...pose.center, ...c[i], ...c[i], ...c[(i + 1) % 4]]);
  };
  const sheet = (c) => [...c[0], ...c[1], ...c[2], ...c[0], ...c[2], ...c[3]];

  function place() {
    const visible = data.cameras.filter((each) => !hidden.has(each));
    for (const kind of KINDS) {
      const part = parts[kind];
      part.owners = isOn(kind) && !through ? visible.filter((each) => each[kind]) : [];
      fill(part.lines, part.owners.flatMap((each) => frame(each[kind], size())));
      fill(part.faces, part.owners.flatMap((each) => {
        const c = corners(each[kind], size());
        return [...[0, 1, 2, 3].flatMap((i) => [...each[kind].center, ...c[i], ...c[(i + 1) % 4]]), ...sheet(c)];
      }));
    }
    // From the prior to what was found, and from that to the truth.
    const steps = through ? [] : visible.flatMap((each) => KINDS.slice(1).flatMap((to, i) =>
      isOn(KINDS[i]) && isOn(to) && each[KINDS[i]] && each[to] ? [...each[KINDS[i]].center, ...each[to].center] : []));
    fill(moves, steps);
    const mine = current && !through && !hidden.has(current) ? KINDS.filter((kind) => isOn(kind) && current[kind]) : [];
    fill(chosen, mine.flatMap((kind) => frame(current[kind], size())));
    photos.clear();
    for (const each of isOn("photo") ? visible : []) {
      if (!each.photo || (through && each !== through.camera)) continue;
      each.material ??= photoMaterial(each.photo);
      each.material.opacity = Number(one(".opacity").value);
      const mesh = new THREE.Mesh(new THREE.BufferGeometry(), each.material);
      fill(mesh, sheet(corners(best(each), size())));
      mesh.geometry.setAttribute("uv", new THREE.Float32BufferAttribute([0, 1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0], 2));
      photos.add(mesh);
    }
    draw();
  }

  function photoMaterial(photo) {
    const texture = new THREE.TextureLoader().load(`data:image/jpeg;base64,${photo}`, draw);
    texture.colorSpace = THREE.SRGBColorSpace;
    return new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, transparent: true });
  }

  function paint() {
    const colour = (name) => new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
    scene.background = colour("paper");
    walls.color = colour("city");
    ink.color = colour("soft");
    for (const material of [grid.material].flat()) {
      material.vertexColors = false;
      material.color = colour("line");
      material.needsUpdate = true;
    }
    for (const [kind, name] of [["prior", "c1"], ["estimate", "c0"], ["truth", "truth"]]) {
      parts[kind].lines.material.color = colour(name);
      parts[kind].faces.material.color = colour(name);
    }
    moves.material.color = colour("soft");
    chosen.material.color = colour("ink");
    draw();
  }

  // Drawn when something changes, not all the time.
  let isAsked = false;
  function draw() {
    if (isAsked) return;
    isAsked = true;
    requestAnimationFrame(() => {
      isAsked = false;
      const { clientWidth: width, clientHeight: height } = stage;
      renderer.setSize(width, height, false);
      eye.aspect = width / height;
      eye.fov = through ? fieldOf(through.pose, eye.aspect) : 45;
      eye.updateProjectionMatrix();
      renderer.render(scene, eye);
    });
  }

  // The vertical angle that takes in all of a photo, and a little more.
  function fieldOf(pose, aspect) {
    const ray = (i) => new THREE.Vector3(...pose.rays.slice(3 * i, 3 * i + 3));
    const tall = ray(3).sub(ray(0)).length();
    const wide = ray(1).sub(ray(0)).length();
    return 2 * Math.atan(0.53 * Math.max(tall, wide / aspect)) * 180 / Math.PI;
  }

  function lookThrough(camera) {
    const pose = best(camera);
    through = { camera, pose, from: through?.from ?? eye.position.clone() };
    const ray = (i) => new THREE.Vector3(...pose.rays.slice(3 * i, 3 * i + 3));
    const right = ray(1).sub(ray(0)).normalize();
    const up = ray(0).sub(ray(3)).normalize();
    eye.position.set(...pose.center);
    eye.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(right, up, right.clone().cross(up)));
    controls.enabled = false;
    one(".through").textContent = "Back";
    place();
  }

  function goBack() {
    if (!through) return;
    eye.position.copy(through.from);
    through = null;
    controls.enabled = true;
    controls.update();
    one(".through").textContent = "Through the camera";
    place();
  }

  function lookAt(middle, distance) {
    goBack();
    const way = eye.position.clone().sub(controls.target);
    controls.target.copy(middle);
    eye.position.copy(middle).add(way.lengthSq() > 1 ? way.setLength(distance) : new THREE.Vector3(0, -distance, distance));
    controls.update();
    draw();
  }

  function choose(each, comes) {
    current = each;
    one(".through").disabled = false;
    one(".about").replaceChildren(...[["", each.key], ...each.facts].map(([name, text]) => {
      const row = document.createElement("div");
      const words = [document.createElement("dt"), document.createElement("dd")];
      [words[0].textContent, words[1].textContent] = [name, text];
      row.append(...(name ? words : [words[1]]));
      return row;
    }));
    for (const entry of entries) entry.row.classList.toggle("current", entry.each === each);
    one(".list .current")?.scrollIntoView({ block: "nearest" });
    if (through) lookThrough(each);
    else if (comes) lookAt(new THREE.Vector3(...best(each).center), Math.max(6 * size(), 40));
    place();
  }

  const entries = data.cameras.map((each) => {
    const row = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = each.key;
    if (each.facts.length) button.append(Object.assign(document.createElement("small"), { textContent: each.facts[0][1] }));
    button.addEventListener("click", () => choose(each, true));
    row.append(button);
    one(".list").append(row);
    return { each, row, text: [each.key, ...each.facts.flat()].join(" ").toLowerCase() };
  });
  const filter = one(".filter");
  const sift = () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    hidden.clear();
    for (const { each, row, text } of entries) {
      row.hidden = !words.every((word) => text.includes(word));
      if (row.hidden) hidden.add(each);
    }
    one(".count").textContent = `${entries.length - hidden.size} of ${entries.length}`;
    place();
  };

  // The camera under the pointer, of those that are shown.
  const pointer = new THREE.Raycaster();
  const under = (event) => {
    if (through) return null;
    const box = canvas.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width;
    const y = (event.clientY - box.top) / box.height;
    pointer.setFromCamera(new THREE.Vector2(2 * x - 1, 1 - 2 * y), eye);
    const hits = KINDS.flatMap((kind) => pointer.intersectObject(parts[kind].faces).map((hit) => ({ ...hit, kind })));
    const nearest = hits.sort((a, b) => a.distance - b.distance)[0];
    return nearest ? { kind: nearest.kind, each: parts[nearest.kind].owners[Math.floor(nearest.faceIndex / 6)] } : null;
  };
  const tip = one(".tip");
  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; tip.hidden = true; });
  canvas.addEventListener("pointermove", (event) => {
    const found = event.buttons ? null : under(event);
    tip.hidden = !found;
    canvas.style.cursor = found ? "pointer" : "";
    if (!found) return;
    tip.textContent = [`${found.each.key} (${found.kind})`, ...found.each.facts.map((fact) => fact.join(" "))].join("; ");
    tip.style.left = `${Math.min(event.offsetX + 12, Math.max(0, stage.clientWidth - tip.offsetWidth))}px`;
    tip.style.top = `${Math.max(0, event.offsetY - tip.offsetHeight - 8)}px`;
  });
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
  canvas.addEventListener("pointerup", (event) => {
    const isPress = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 5;
    const found = isPress ? under(event) : null;
    if (found) choose(found.each, false);
  });
  controls.addEventListener("change", draw);
  addEventListener("keydown", (event) => { if (event.key === "Escape") goBack(); });
  one(".through").addEventListener("click", () => (through ? goBack() : lookThrough(current)));
  // What the whole view takes in: cameras, what they look at, and the buildings near both.
  function worthSeeing() {
    const poses = data.cameras.flatMap((each) => KINDS.filter((kind) => each[kind]).map((kind) => each[kind]));
    const points = poses.flatMap((pose) => [pose.center, ...corners(pose, size())].map((p) => new THREE.Vector3(...p)));
    const spots = poses.flatMap((pose) => [pose.center, seenFrom(pose, ground)]);
    const most = Math.max(0.5 * (high.z - ground), 60);
    const near = boxNear(geometry, spots, most);
    return near ? [...points, ...near] : points;
  }
  const whole = () => {
    goBack();
    const { clientWidth: width, clientHeight: height } = stage;
    eye.aspect = width / height;
    eye.fov = 45;
    eye.updateMatrixWorld();
    const bar = one(".buttons").getBoundingClientRect().bottom - stage.getBoundingClientRect().top;
    const fitted = fittingEye(worthSeeing(), eye.quaternion, eye.aspect, eye.fov, bar / height);
    eye.position.copy(fitted.position);
    controls.target.copy(fitted.target);
    controls.update();
    draw();
  };
  one(".whole").addEventListener("click", whole);
  for (const input of all(".legend input, .sliders input")) input.addEventListener("input", place);
  filter.addEventListener("input", sift);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  new ResizeObserver(draw).observe(stage);

  paint();
  eye.position.set(-0.5, -1, 1);
  eye.lookAt(0, 0, 0);
  sift();
  whole();
  const asked = decodeURIComponent(location.hash.slice(1));
  const linked = data.cameras.find((each) => each.key === asked);
  if (linked) choose(linked, true);
}

(async () => {
  const state = one(".state");
  try {
    const script = document.createElement("script");
    script.textContent = await unpacked("three");
    document.head.append(script);
    main(JSON.parse(await unpacked("document")));
    state.textContent = "";
  } catch (error) {
    state.textContent = `This browser cannot show it: ${error.message}`;
  }
})();
