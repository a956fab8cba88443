#version 330
// How much light the body over it keeps from the floor.
in vec2 v_uv;
uniform sampler2D shadow;
out vec4 rgb;
void main() {
    rgb = vec4(0.0, 0.0, 0.0, texture(shadow, v_uv).r);
}
