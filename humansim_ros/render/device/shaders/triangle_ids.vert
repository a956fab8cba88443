#version 330
// A surface in the world, for depth and triangle ids.
in vec3 position;
uniform vec4 optical_z;  // third row of the world-to-optical transform
out float v_z;
void main() {
    gl_Position = projected(position);
    v_z = dot(optical_z, vec4(position, 1.0));
}
