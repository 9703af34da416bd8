// Canvases, and WebGL's programs.

// Gives canvases the pixels that they have on the screen; returns these for each pixel of the page.
export function fit(...canvases) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth, clientHeight } = canvases.at(-1);
  const [width, height] = [clientWidth, clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
  for (const canvas of canvases) {
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  }
  return ratio;
}

// A program of these shaders, in use.
export function link(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  return program;
}
