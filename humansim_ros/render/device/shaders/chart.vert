#version 330
// The static scene as it is laid out in the light map: points, and normals.
in vec3 position;
in vec3 normal;
in vec2 light_uv;
out vec3 v_world;
out vec3 v_normal;
void main() {
    gl_Position = vec4(2.0 * light_uv - 1.0, 0.0, 1.0);
    v_world = position;
    v_normal = normal;
}
