#version 330
// A surface in the world; rows of `optical` are the world-to-optical transform.
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 color;
uniform mat4 clip;
uniform vec4 optical_z;
out vec3 v_normal;
out vec3 v_position;
out vec2 v_uv;
out vec3 v_color;
out float v_z;
void main() {
    gl_Position = clip * vec4(position, 1.0);
    v_z = dot(optical_z, vec4(position, 1.0));
    v_normal = normal;
    v_position = position;
    v_uv = uv;
    v_color = color;
}
