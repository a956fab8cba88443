#version 330
// Share of the light that a body blocks on the floor.
in vec2 v_uv;
uniform sampler2D shadow;
out vec4 rgb;
void main() {
    rgb = vec4(0.0, 0.0, 0.0, texture(shadow, v_uv).r);
}
