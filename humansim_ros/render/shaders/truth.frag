#version 330
// Exact labels and depth of the pixel's centre.
in float v_z;
uniform usampler2D parts;  // one texel per triangle, in rows of 1024
uniform uint instance;
layout(location = 0) out uint label;
layout(location = 1) out float depth;
void main() {
    label = (instance << 8) | texelFetch(parts, ivec2(gl_PrimitiveID & 1023, gl_PrimitiveID >> 10), 0).r;
    depth = v_z;
}
