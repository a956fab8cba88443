#version 330
// The static scene, for its ambient occlusion.
in vec3 position;
in vec3 normal;
uniform vec4 optical_z;
out vec3 v_world;
out vec4 v_normal;
void main() {
    gl_Position = projected(position);
    v_world = position;
    v_normal = vec4(normal, dot(optical_z, vec4(position, 1.0)));
}
