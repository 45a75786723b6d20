// The turntable: a slider chooses the frame.
for (const turn of document.querySelectorAll(".turn")) {
  const slider = turn.querySelector("input");
  slider.addEventListener("input", () => {
    for (const frames of turn.querySelectorAll(".frames")) {
      frames.dataset.at = slider.value;
      [...frames.children].forEach((image, i) => image.classList.toggle("shown", i === Number(slider.value)));
    }
  });
}

// Starts the 3D view when asked to: until then neither its program nor the model costs anything.
(() => {
  const button = document.getElementById("start-3d");
  if (!button) return;
  const stage = document.getElementById("stage-3d");
  const fail = (words) => {
    button.textContent = words;
    button.disabled = true;
  };
  const bytes = (id) => {
    const text = atob(document.getElementById(id).textContent);
    return Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  };
  button.addEventListener("click", () => {
    button.textContent = "Loading ...";
    button.disabled = true;
    requestAnimationFrame(() => setTimeout(start, 0));
  });
  function start() {
    if (!window.WebGL2RenderingContext) return fail("This browser has no WebGL: open asset.glb instead");
    const program = document.createElement("script");
    program.textContent = document.getElementById("viewer").textContent;
    document.head.append(program);
    const view = document.createElement("model-viewer");
    view.setAttribute("alt", "the asset, to be turned");
    for (const name of ["camera-controls", "interaction-prompt", "tone-mapping", "shadow-intensity", "touch-action"]) {
      const values = { "interaction-prompt": "none", "tone-mapping": "neutral", "shadow-intensity": "0.7", "touch-action": "pan-y" };
      view.setAttribute(name, values[name] || "");
    }
    view.addEventListener("load", () => stage.setAttribute("data-state", "loaded"));
    choose(view);
    view.addEventListener("error", () => {
      view.remove();
      stage.append(button);
      fail("The 3D view could not start: open asset.glb instead");
    });
    view.src = URL.createObjectURL(new Blob([bytes("glb")], { type: "model/gltf-binary" }));
    stage.replaceChildren(view);
  }

  // What is shown of the asset. The viewer has no setting for it, so the shaders of its materials
  // are told to put out one of the values that they work with.
  const outputs = { // data is shown as it is: the screen's curve is taken back
    asset: "",
    color: "outgoingLight = diffuseColor.rgb;",
    rough: "outgoingLight = pow(vec3(roughnessFactor), vec3(2.2));",
    metal: "outgoingLight = pow(vec3(metalnessFactor), vec3(2.2));",
    normal: "outgoingLight = pow(normal * 0.5 + 0.5, vec3(2.2));",
    seen: "outgoingLight = totalEmissiveRadiance;",
  };
  const told = {
    asset: "",
    color: "The colour of the material, without light and shadow.",
    rough: "White is rough, black is a mirror.",
    metal: "White is metal.",
    normal: "The colour says where the surface faces, as you see it.",
    seen: "White: the photos tell its shape. Dark: its shape is a guess. Black: no photo saw it, and its colour is a guess too.",
  };

  function materials(view) {
    const key = Object.getOwnPropertySymbols(view).find((symbol) => symbol.description === "scene");
    const found = [];
    if (key) view[key].traverse((part) => part.isMesh && found.push(...[part.material].flat()));
    return found.filter((material) => material && material.isMeshStandardMaterial);
  }

  function draw(view, shown, isWire) {
    for (const material of materials(view)) {
      material.onBeforeCompile = (shader) => {
        const mark = shader.fragmentShader.includes("#include <opaque_fragment>") ? "opaque" : "output";
        const line = `#include <${mark}_fragment>`;
        shader.fragmentShader = shader.fragmentShader.replace(line, `${outputs[shown]}\n${line}`);
      };
      material.customProgramCacheKey = () => shown;
      material.toneMapped = shown === "asset";
      material.wireframe = isWire;
      material.needsUpdate = true;
    }
    const key = Object.getOwnPropertySymbols(view).find((symbol) => symbol.description === "scene");
    if (key && view[key].queueRender) view[key].queueRender();
  }

  async function choose(view) {
    const box = document.getElementById("choices-3d");
    await new Promise((done) => view.addEventListener("load", done, { once: true }));
    const emissive = document.getElementById("seen") && (await view.createTexture(document.getElementById("seen").textContent));
    const light = document.getElementById("light") && `${URL.createObjectURL(new Blob([bytes("light")]))}#.hdr`; // the viewer tells the format by the end of the name
    const chosen = (name) => (box.querySelector(`input[name=${name}]:checked`) || {}).value;
    box.hidden = materials(view).length === 0;
    box.addEventListener("change", () => {
      const shown = chosen("show");
      for (const material of emissive ? view.model.materials : []) {
        material.emissiveTexture.setTexture(shown === "seen" ? emissive : null);
        material.setEmissiveFactor(shown === "seen" ? [1, 1, 1] : [0, 0, 0]);
      }
      if (chosen("lit") === "found") view.setAttribute("environment-image", light);
      else view.removeAttribute("environment-image");
      draw(view, shown, document.getElementById("wire-3d").checked);
      document.getElementById("told-3d").textContent = told[shown];
    });
  }
})();
