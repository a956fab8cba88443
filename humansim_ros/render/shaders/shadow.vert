#version 330
// A rectangle on the floor.
in vec2 corner;
uniform mat4 clip;
uniform vec4 place;  // x, y of its low corner, side lengths
out vec2 v_uv;
void main() {
    v_uv = corner;
    gl_Position = clip * vec4(place.xy + corner * place.zw, 0.003, 1.0);
}
