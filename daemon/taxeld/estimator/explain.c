/* How well poses explain remembered scans: `Memory.explain` of memory.py, pose by pose, without the
   arrays that numpy makes on the way. Any change here is a change there; tests hold both equal.
   Built with -ffast-math: nothing in here is infinite or not a number. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

/* SHA-256 of this file, as it was built */
const char taxeld_source[] = SOURCE;

enum { Z, LEVEL, RESIDUE, LOW, HIGH, ROOT, SILENT, LIVE, FIELDS };

typedef struct {
    const float *slices;  /* (heights, ny, nx) signed distances [m] */
    const uint8_t *pressed, *about, *reach;  /* (ny, nx) cells that count, of a taxel or an axis */
    const float *place;  /* (3, places) x, y [m], 1: taxels stand in columns */
    const int64_t *taxel, *offset;  /* (places, most) which they are, or -1; where their slice is */
    int64_t nx, ny, places, most, taxels;
    double x, y, cell, depth_max;  /* of the grid's origin, of its cells, of full scale [m] */
    double band, hidden, robust;  /* BAND_M, HIDDEN and ROBUST */
    double least_variance, iterations;
    double sigma, gain_cv, outliers, least, farthest, bowling1, bowling3;  /* of `Noise` */
} Model;

typedef struct {
    const float *kept;  /* (FIELDS, scans, taxels) */
    const double *sensor;  /* (scans, 3) */
    const double *variance;  /* (scans,) of each one's offset [m^2] */
    const uint8_t *silent;  /* (scans,) */
    int64_t scans, about;  /* about: whether contacts have an offset */
} Scans;

typedef struct {  /* the taxels near a press, one after the other */
    float *depth, *gx, *gy, *away, *ax, *ay, *low, *high;
    int64_t *taxel;
    int64_t n;
} Near;

static float within(float value, float low, float high)
{
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* Of whatever a pose that is not a number becomes, too. */
static int is_inside(const Model *m, int64_t column, int64_t row)
{
    return (uint64_t)column < (uint64_t)m->nx - 1 && (uint64_t)row < (uint64_t)m->ny - 1;
}

/* The taxels that a pose presses, or nearly, the sensor at (x, y) in cells and turned by `turn`. */
static void look_up(const Model *m, Near *near, double x, double y, double turn, int about)
{
    const float *px = m->place, *py = px + m->places;
    float c = cos(turn) / m->cell, s = sin(turn) / m->cell, x0 = x, y0 = y;
    float right = m->nx - 1.001, top = m->ny - 1.001, band = about ? m->band : 0.0;
    float by_depth = -1.0 / m->depth_max, by_cell = by_depth / m->cell;
    const uint8_t *mask = about ? m->about : m->pressed;
    near->n = 0;
    for (int64_t i = 0; i < m->places; i++) {
        float u = within(c * px[i] - s * py[i] + x0, 0.0f, right);
        float v = within(s * px[i] + c * py[i] + y0, 0.0f, top);
        int64_t column = (int64_t)u, row = (int64_t)v, cell = row * m->nx + column;
        if (!is_inside(m, column, row) || !mask[cell])
            continue;
        u -= column;
        v -= row;
        for (int64_t j = i * m->most; j < (i + 1) * m->most && m->taxel[j] >= 0; j++) {
            const float *at = m->slices + m->offset[j] + cell;
            float below = at[1] - at[0], above = at[m->nx + 1] - at[m->nx];
            float low = at[0] + below * u, high = at[m->nx] + above * u;
            float distance = low + (high - low) * v;
            if (!(distance < band))
                continue;
            near->taxel[near->n] = m->taxel[j];
            near->depth[near->n] = distance * by_depth;
            near->gx[near->n] = (below + (above - below) * v) * by_cell;
            near->gy[near->n++] = (high - low) * by_cell;
        }
    }
}

/* `Readings.offset` of offsets.py: moves the depths to where the offset explains the readings best;
   what the integral over it adds. */
static double offset(const Model *m, Near *near, const float *kept, int64_t field, double variance)
{
    double precision = 1.0 / (variance > m->least_variance ? variance : m->least_variance);
    double x = 0.0, y = 0.0, det = precision * precision;
    float robust = m->robust;
    if (!near->n)
        return 0.0;
    for (int64_t i = 0; i < near->n; i++) {
        const float *at = kept + near->taxel[i];
        float root = at[ROOT * field];
        near->away[i] = (at[LEVEL * field] - near->depth[i]) * root;
        near->ax[i] = near->gx[i] * root;
        near->ay[i] = near->gy[i] * root;
        near->low[i] = at[LOW * field];
        near->high[i] = at[HIGH * field];
    }
    for (int iteration = 0; iteration < (int)m->iterations; iteration++) {
        float xx = 0, xy = 0, yy = 0, bx = 0, by = 0, ex = x, ey = y;
        for (int64_t i = 0; i < near->n; i++) {
            float ax = near->ax[i], ay = near->ay[i];
            float off = within(near->away[i] - ax * ex - ay * ey, near->low[i], near->high[i]);
            float size = fabsf(off), weight = size > robust ? robust / size : 1.0f;
            weight = off == 0.0f ? 0.0f : weight;
            xx += weight * ax * ax;
            xy += weight * ax * ay;
            yy += weight * ay * ay;
            bx += weight * ax * off;
            by += weight * ay * off;
        }
        double hxx = xx + precision, hyy = yy + precision, hxy = xy;
        double rx = bx - precision * x, ry = by - precision * y;
        det = hxx * hyy - hxy * hxy;
        x += (hyy * rx - hxy * ry) / det;
        y += (hxx * ry - hxy * rx) / det;
    }
    float ex = x, ey = y;
    for (int64_t i = 0; i < near->n; i++)
        near->depth[i] += near->gx[i] * ex + near->gy[i] * ey;
    return -0.5 * ((x * x + y * y) * precision + log(det / (precision * precision)));
}

/* By how much readings are likelier at these depths than of taxels that are not pressed:
   `Noise.log_density`. */
static double gain(const Model *m, const Near *near, const float *kept, int64_t field)
{
    float sigma2 = m->sigma * m->sigma, cv2 = m->gain_cv * m->gain_cv, farthest = m->farthest;
    float b1 = m->bowling1, b3 = m->bowling3, keep = 1.0 - m->outliers, least = m->least;
    float sum = 0.0f;
    for (int64_t i = 0; i < near->n; i++) {
        const float *at = kept + near->taxel[i];
        float z = at[Z * field], residue = at[RESIDUE * field];
        float h = within(near->depth[i], 0.0f, 1.0f);
        float variance = sigma2 + cv2 * h * h + residue * residue;
        float off = within((at[LEVEL * field] - h) / sqrtf(variance), -farthest, farthest);
        float square = off * off, likely;
        if (z > 0.0f && z < 1.0f)
            likely = expf(-0.5f * square) / sqrtf(6.2831853f * variance);
        else
            likely = 1.0f / (1.0f + expf((z > 0.0f ? off : -off) * (b1 + b3 * square)));
        sum += (logf(keep * likely + least) - at[SILENT * field]) * at[LIVE * field];
    }
    return sum;
}

/* log p(scan | pose) beyond that of a skin which is not pressed, of poses (n, 3): out (n, scans).
   0, or -1 where there is no memory left. */
int taxeld_explain(const Model *m, const Scans *s, const double *poses, int64_t n, double *out)
{
    int64_t field = s->scans * m->taxels;
    float *room = malloc(m->taxels * (8 * sizeof(float) + sizeof(int64_t)));
    if (!room)
        return -1;
    float *each[8];
    Near near = {.taxel = (int64_t *)room};
    for (int i = 0; i < 8; i++)
        each[i] = (float *)(near.taxel + m->taxels) + i * m->taxels;
    near.depth = each[0], near.gx = each[1], near.gy = each[2], near.away = each[3];
    near.ax = each[4], near.ay = each[5], near.low = each[6], near.high = each[7];
    for (int64_t i = 0; i < n; i++) {
        const double *pose = poses + 3 * i;
        double c = cos(pose[2]), sn = sin(pose[2]);
        for (int64_t k = 0; k < s->scans; k++) {
            const double *sensor = s->sensor + 3 * k;
            double dx = sensor[0] - pose[0], dy = sensor[1] - pose[1], met = 0.0;
            double x = (c * dx + sn * dy - m->x) / m->cell, y = (c * dy - sn * dx - m->y) / m->cell;
            int64_t column = (int64_t)within(x, 0.0f, m->nx - 1.001);
            int64_t row = (int64_t)within(y, 0.0f, m->ny - 1.001);
            if (is_inside(m, column, row) && m->reach[row * m->nx + column]) {
                int about = s->about && !s->silent[k];
                const float *kept = s->kept + k * m->taxels;
                look_up(m, &near, x, y, sensor[2] - pose[2], about);
                if (about) {
                    met = offset(m, &near, kept, field, s->variance[k]);
                } else {
                    float hidden = m->hidden / m->depth_max * sqrt(s->variance[k]);
                    for (int64_t j = 0; j < near.n; j++)
                        near.depth[j] -= hidden;
                }
                met += gain(m, &near, kept, field);
            }
            out[i * s->scans + k] = met;
        }
    }
    free(room);
    return 0;
}
