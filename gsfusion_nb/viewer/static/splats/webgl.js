// Drawing with the graphics card: one quad per Gaussian, farthest first, the projection in the vertex shader (splat.vert).

/** Name of the graphics card; "" where there is no WebGL2. */
export function gpuName() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return "";
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext(); // a page may have only about 16 contexts
  return name || "unknown";
}

/** A renderer that only emulates a graphics card: slower than drawing on the CPU directly. */
export const imitatesGpu = (name) => /swiftshader|llvmpipe|softpipe|software|basic render|paravirtual/i.test(name);

export class GpuPainter {
  constructor(canvas) {
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true }));
    if (!gl) throw new Error("this browser gives no WebGL2 context");
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.count = 0;
    this.buffers = [
      this.attribute(0, 2, gl.FLOAT, false, 0),
      this.attribute(1, 1, gl.UNSIGNED_INT, false, 1),
      this.attribute(2, 4, gl.UNSIGNED_BYTE, true, 1),
    ];
    this.fill(0, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  attribute(place, width, type, normalised, divisor) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(place);
    if (type === gl.UNSIGNED_INT) gl.vertexAttribIPointer(place, width, type, 0, 0);
    else gl.vertexAttribPointer(place, width, type, normalised, 0, 0);
    gl.vertexAttribDivisor(place, divisor);
    return buffer;
  }

  fill(place, data) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.buffers[place]);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, data, this.gl.DYNAMIC_DRAW);
  }

  /** The texture that `Engine.texture` made. */
  receive(data) {
    const { gl } = this;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3072, data.length / 12288, 0, gl.RGBA, gl.FLOAT, data);
  }

  arrange(order, colours) {
    this.count = order.length;
    this.fill(1, order);
    this.fill(2, colours);
  }

  paint(view, look, rules) {
    const { gl, program } = this;
    const set = (name, kind, ...values) => gl[`uniform${kind}`](gl.getUniformLocation(program, name), ...values);
    gl.viewport(0, 0, view.width, view.height);
    gl.clearColor(...look.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    set("R", "Matrix3fv", true, view.R);
    set("t", "3f", ...view.t);
    set("lens", "4f", view.fx, view.fy, view.cx, view.cy);
    set("size", "2f", view.width, view.height);
    set("look", "4f", look.size, look.opacity, look.points ? 1 : 0, rules.clamp);
    set("rules", "3f", rules.near_m, rules.blur_px2, rules.alpha_min);
    set("alphaRange", "2f", rules.alpha_min, rules.alpha_max);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
  }

  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
