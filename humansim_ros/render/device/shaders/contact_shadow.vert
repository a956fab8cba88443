#version 330
// A rectangle on the floor, above the height of a rug. It writes no depth, so that it does not hide feet.
in vec2 corner;
uniform vec4 rectangle;  // x, y of the low corner, side lengths
out vec2 v_uv;
void main() {
    v_uv = corner;
    gl_Position = projected(vec3(rectangle.xy + corner * rectangle.zw, 0.01));
}
