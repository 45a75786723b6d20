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
    const label = document.getElementById("light-3d");
    if (label) {
      // The viewer tells the format by the end of the name.
      const light = `${URL.createObjectURL(new Blob([bytes("light")]))}#.hdr`;
      label.hidden = false;
      label.querySelector("input").addEventListener("change", (event) => {
        if (event.target.checked) view.setAttribute("environment-image", light);
        else view.removeAttribute("environment-image");
      });
    }
    view.addEventListener("error", () => {
      view.remove();
      stage.append(button);
      fail("The 3D view could not start: open asset.glb instead");
    });
    view.src = URL.createObjectURL(new Blob([bytes("glb")], { type: "model/gltf-binary" }));
    stage.replaceChildren(view);
  }
})();
