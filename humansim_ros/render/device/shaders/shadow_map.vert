#version 330
// A surface from a direction of light.
in vec3 position;
uniform mat4 clip;
#ifdef PBR
in vec2 uv;
out vec2 v_uv;
#endif
void main() {
    gl_Position = clip * vec4(position, 1.0);
#ifdef PBR
    v_uv = uv;
#endif
}
