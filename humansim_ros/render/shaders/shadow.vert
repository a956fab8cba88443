#version 330
// A rectangle on the floor, high enough to lie over a rug (it writes no depth, so that feet are not hidden).
in vec2 corner;
uniform vec4 place;  // x, y of its low corner, side lengths
out vec2 v_uv;
void main() {
    v_uv = corner;
    gl_Position = projected(vec3(place.xy + corner * place.zw, 0.01));
}
