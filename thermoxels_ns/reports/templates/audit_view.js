(async () => {
  const part = id => document.getElementById(id);
  const unpacked = id => {
    const bytes = Uint8Array.from(atob(part(id).textContent), sign => sign.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  try {
    if (!document.createElement("canvas").getContext("webgl")) throw new Error("no WebGL");
    const script = document.createElement("script");
    script.textContent = await unpacked("plotly-packed");
    document.head.append(script);
    const data = JSON.parse(await unpacked("view-packed"));
    const [x, y, z] = data.points.map(row => row.map(mm => mm / 1000));
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const told = data.patch.map((patch, n) => data.patches[patch] + data.quantities.map(one =>
      `<br>${one.name} ${one.values[n]} ${one.unit}`).join(""));
    const box = part("view-drawn"), chosen = part("view-quantity");
    data.quantities.forEach((one, n) => chosen.add(new Option(`${one.name}, ${one.unit}`, n)));
    const quantity = () => data.quantities[chosen.value];
    let eye = data.eye;
    const [lx, ly, lz] = eye.map((value, n) => 1e5 * (value + 0.8 * data.up[n] + 0.5 * cross(data.up, eye)[n]));
    const lamp = {x: lx, y: ly, z: lz};
    // From inside, walls between the reader and the room are left out: those whose front the reader does not see.
    const facing = ([i, j, k]) => i.map((a, n) => n).filter(n => {
      if (!data.inside) return true;
      const at = m => [x[m], y[m], z[m]], a = at(i[n]), off = m => at(m).map((value, axis) => value - a[axis]);
      return dot(cross(off(j[n]), off(k[n])), eye) > 0;
    });
    const corners = (facets, which) => ({i: which.map(n => facets[0][n]), j: which.map(n => facets[1][n]),
      k: which.map(n => facets[2][n])});
    const meshes = () => {
      const which = facing(data.counted), one = quantity();
      // Without these two, plotly takes small triangles for flat ones without a side, and shades none of them.
      const light = {ambient: 0.8, diffuse: 0.3, specular: 0, fresnel: 0, facenormalsepsilon: 0,
        vertexnormalsepsilon: 0};
      const same = {type: "mesh3d", x, y, z, flatshading: true, lighting: light, lightposition: lamp};
      return [
        {...same, ...corners(data.counted, which), intensitymode: "cell", intensity: which.map(n => one.values[n]),
          cmin: one.low, cmax: one.high, colorscale: one.scale, hoverinfo: "text", hovertext: which.map(n => told[n]),
          colorbar: {orientation: "h", y: -0.02, yanchor: "top", thickness: 14, len: 0.9,
            title: {text: `${one.name} [${one.unit}]`, side: "top"}}},
        {...same, ...corners(data.others, facing(data.others)), color: "#d4d7dc",
          lighting: {...light, ambient: 0.55, diffuse: 0.55}, hoverinfo: "text",
          hovertext: "does not count"},
        {type: "scatter3d", mode: "markers+text", x: data.bridges.map(one => one.at[0] / 1000),
          y: data.bridges.map(one => one.at[1] / 1000), z: data.bridges.map(one => one.at[2] / 1000),
          text: data.bridges.map(one => `<b>${one.number}</b>`), textposition: "middle center", showlegend: false,
          textfont: {size: 12, color: "#1d2430"}, marker: {size: 11, color: "#fff", line: {color: "#1d2430", width: 2}},
          hoverinfo: "text", hovertext: data.bridges.map(one => one.text)},
      ];
    };
    const axis = {visible: false, showspikes: false};
    const [ux, uy, uz] = data.up;
    const layout = {margin: {l: 0, r: 0, t: 0, b: 70}, uirevision: "same", hoverlabel: {align: "left"},
      font: {family: getComputedStyle(document.body).fontFamily},
      scene: {aspectmode: "data", xaxis: axis, yaxis: axis, zaxis: axis, dragmode: "orbit",
        camera: {eye: {x: eye[0], y: eye[1], z: eye[2]}, up: {x: ux, y: uy, z: uz}, center: {x: 0, y: 0, z: 0}}}};
    const options = {responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false};
    part("view").hidden = false;
    await Plotly.newPlot(box, meshes(), layout, options);
    const draw = () => Plotly.react(box, meshes(), box.layout, options);
    chosen.addEventListener("change", draw);
    const look = to => Plotly.relayout(box, {"scene.camera.eye": {x: to[0], y: to[1], z: to[2]}});
    box.on("plotly_relayout", () => {
      const at = box.layout.scene.camera.eye;
      eye = [at.x, at.y, at.z];
      if (data.inside) draw();
    });
    box.on("plotly_click", event => {
      const one = event.points[0];
      if (one.curveNumber === 2) part(`bridge-${data.bridges[one.pointNumber].number}`)?.scrollIntoView();
    });
    for (const button of part("view").querySelectorAll("button")) button.addEventListener("click", () => {
      const {turn, nearer} = button.dataset, angle = Number(turn ?? 0);
      const aside = cross(data.up, eye), along = dot(data.up, eye) * (1 - Math.cos(angle));
      look(eye.map((value, n) =>
        (value * Math.cos(angle) + aside[n] * Math.sin(angle) + data.up[n] * along) * Number(nearer ?? 1)));
    });
    part("view").parentElement.classList.add("live");
  } catch (problem) {
    console.error(problem);
    part("view").hidden = true;
    part("view-failed").hidden = false;
  }
})();
