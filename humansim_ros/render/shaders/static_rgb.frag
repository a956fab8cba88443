#version 330
// The static scene, drawn once: its colour, and its depth so that it hides what stands behind it.
uniform sampler2D static_rgb;
uniform sampler2D static_depth;
uniform vec2 depth_row;  // depth buffer value = x + y / z
out vec4 rgb;
void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    rgb = texelFetch(static_rgb, pixel, 0);
    gl_FragDepth = min(1.0, depth_row.x + depth_row.y / texelFetch(static_depth, pixel, 0).r);
}
