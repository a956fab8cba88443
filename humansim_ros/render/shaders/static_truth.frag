#version 330
// The static scene, drawn once: no body's label, its own depth.
uniform sampler2D static_depth;
uniform vec2 depth_row;  // depth buffer value = x + y / z
layout(location = 0) out uint label;
layout(location = 1) out float depth;
void main() {
    float z = texelFetch(static_depth, ivec2(gl_FragCoord.xy), 0).r;
    label = 0u;
    depth = z;
    gl_FragDepth = min(1.0, depth_row.x + depth_row.y / z);
}
